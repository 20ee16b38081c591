/* A small file of the node's outputs, mapped into memory, so that a test can read them from outside.
 *
 * Numbers have the processor's byte order. `sequence` is odd while the file changes: read it before and after. */
#ifndef WITNESS_H
#define WITNESS_H

#include "rtloop_node.h"

#define WITNESS_MAGIC 0x57544E52u /* "RNTW" */

struct witness_output {
    int32_t code;
    uint32_t change;              /* largest change of the code from one write to the next */
    uint32_t change_per_ms;       /* largest change of the code within 1 ms of the node's clock */
    uint32_t reserved;
};

struct witness {
    uint32_t magic;
    uint32_t sequence;
    uint32_t outputs;
    uint32_t digital;
    uint64_t writes;
    uint64_t watchdog_trips;
    struct witness_output output[RTLOOP_MAX_CHANNELS];
};

/* Make the file; return false, after a message, if that fails. */
bool witness_open(const char *path, uint8_t outputs);

/* Enter a write of the outputs at a time of the node's clock; does nothing without a file. */
void witness_write(const int32_t *codes, uint16_t digital, uint64_t now_us);

/* Enter the number of watchdog trips; does nothing without a file. */
void witness_trips(uint32_t watchdog_trips);

#endif

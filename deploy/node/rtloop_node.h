/* The node's side of the protocol in docs/node-protocol.md, as a library for a firmware.
 *
 * The library allocates nothing, has no global state, computes with integers only, and calls nothing of the C library
 * but memcpy and memset. One node is used from one context: no interrupt may call into it while another call runs. */
#ifndef RTLOOP_NODE_H
#define RTLOOP_NODE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "rtloop_frame.h"

#ifdef __cplusplus
extern "C" {
#endif

#define RTLOOP_NODE_MAX_ANSWER RTLOOP_MAX_ANSWER

/* An input or an output as WELCOME describes it: volts = volts_at_zero + code * volts_per_code. */
struct rtloop_node_channel {
    int32_t lowest;
    int32_t highest;
    int32_t safe;                 /* 0 for an input */
    uint32_t change_per_ms;       /* largest change of the code in 1 ms of a ramp, at least 1; 0 for an input */
    double volts_per_code;
    double volts_at_zero;
};

/* What the board is; the node keeps a pointer to it. */
struct rtloop_node_config {
    uint8_t inputs;               /* at least 1 */
    uint8_t outputs;              /* at least 1; inputs and outputs together at most 44 */
    uint8_t digital_inputs;       /* at most 16 */
    uint8_t digital_outputs;      /* at most 16 */
    uint32_t longest_hold_us;     /* longest time without a DRIVE before the watchdog parks, at least 1 */
    uint32_t shortest_period_us;  /* shortest period from DRIVE to DRIVE; the loop keeps it */
    const struct rtloop_node_channel *input;
    const struct rtloop_node_channel *output;
    const uint8_t *key;           /* 16 random bytes, not all equal; NULL: whoever reaches the node may drive it */
    void *context;                /* first argument of the functions below */
    /* Convert all inputs now. */
    void (*read_inputs)(void *context, int32_t *codes, uint16_t *digital);
    /* Set all outputs; each code is within its channel's range. */
    void (*write_outputs)(void *context, const int32_t *codes, uint16_t digital);
    /* Return a clock in ns for the age of a sample; NULL: the age is 0. */
    uint64_t (*now_ns)(void *context);
};

struct rtloop_node_counters {
    uint32_t invalid;             /* frames with another length, header, format or check */
    uint32_t old;                 /* DRIVEs that were not newer than the newest one */
    uint32_t refused;             /* frames that were answered by a REFUSAL */
    uint32_t sessions;            /* sessions that were opened: the opening of the next one */
    uint32_t watchdog_trips;      /* sessions that the watchdog ended */
    uint32_t foreign;             /* DRIVEs with another tag or, of the session, from another address: with a key alone */
};

/* A node. Read its fields freely, and change none. */
struct rtloop_node {
    const struct rtloop_node_config *config;
    uint64_t now_us;              /* latest time that any call gave */
    uint64_t accepted_us;         /* time of the newest accepted DRIVE */
    uint64_t step_us;             /* time at which the next step of the ramp is due */
    uint64_t sender;              /* address of the session's loop */
    uint64_t parked_sender;       /* address of the loop that ended a session by PARK last */
    uint32_t boot;
    uint32_t session;             /* 0: no loop drives the node */
    uint32_t parked_session;      /* session that ended by PARK last; 0: none */
    uint32_t tripped_session;     /* session that the watchdog ended last; 0: none */
    uint32_t newest;              /* sequence of the newest accepted DRIVE */
    uint32_t turn;                /* how often the sequence has passed 0 since the session's OPEN */
    uint32_t applied;             /* sequence of the DRIVE whose codes are at the outputs; 0: none */
    uint32_t hold_us;             /* hold of the newest accepted DRIVE */
    bool ramping;
    uint16_t digital;
    int32_t codes[RTLOOP_MAX_CHANNELS];
    struct rtloop_node_counters counters;
};

/* Start a node with its outputs at their safe codes; return false, and write nothing, if the configuration is not allowed.
 * `boot` is never the same number twice, or recorded frames fit again: take it from a generator in hardware or a counter in
 * flash. `now_us` is a clock that never stops or steps while the node runs. */
bool rtloop_node_init(struct rtloop_node *node, const struct rtloop_node_config *config, uint32_t boot, uint64_t now_us);

/* Process one frame from the address `sender`, and return the number of bytes in `answer` to send there; 0: none. */
size_t rtloop_node_receive(struct rtloop_node *node, const uint8_t *frame, size_t length, uint64_t sender, uint64_t now_us,
                           uint8_t answer[RTLOOP_NODE_MAX_ANSWER]);

/* Run the watchdog, and the step of a ramp that is due; call this at least once per millisecond. */
void rtloop_node_poll(struct rtloop_node *node, uint64_t now_us);

/* End the session, if there is one, and ramp the outputs to their safe codes: for a stop button or a shutdown. */
void rtloop_node_park(struct rtloop_node *node, uint64_t now_us);

/* Return the time at which rtloop_node_poll has to act next; UINT64_MAX if only a frame can change that. */
uint64_t rtloop_node_due_us(const struct rtloop_node *node);

/* Return whether all outputs have their safe codes. */
bool rtloop_node_at_safe(const struct rtloop_node *node);

/* Return a time of 64 bits from a clock of 32 bits that wraps, such as Arduino's micros(); call it once an hour or oftener. */
static inline uint64_t rtloop_node_extend_us(uint64_t previous_us, uint32_t clock_us)
{
    return previous_us + (uint32_t)(clock_us - (uint32_t)previous_us);
}

#ifdef __cplusplus
}
#endif

#endif

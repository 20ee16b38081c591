#include "witness.h"

#include <errno.h>
#include <fcntl.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

enum { HISTORY = 256 };

static struct witness *witness;

/* The latest writes, so that a change within 1 ms can be found. */
static struct {
    uint64_t time_us;
    int32_t codes[RTLOOP_MAX_CHANNELS]; /* before the write */
} history[HISTORY];

bool witness_open(const char *path, uint8_t outputs)
{
    int file = open(path, O_RDWR | O_CREAT | O_TRUNC | O_NOFOLLOW | O_CLOEXEC, 0644);
    if (file >= 0 && ftruncate(file, sizeof *witness) == 0) {
        void *memory = mmap(NULL, sizeof *witness, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
        witness = memory != MAP_FAILED ? memory : NULL;
    }
    if (witness == NULL) {
        fprintf(stderr, "--witness: %s: %s\n", path, strerror(errno));
        return false;
    }
    close(file);
    witness->outputs = outputs;
    witness->magic = WITNESS_MAGIC;
    return true;
}

/* Mark the file as changing, or as complete. */
static void count(void)
{
    atomic_thread_fence(memory_order_seq_cst);
    *(volatile uint32_t *)&witness->sequence += 1;
    atomic_thread_fence(memory_order_seq_cst);
}

/* Return the larger of a change and the distance of two codes. */
static uint32_t larger(uint32_t change, int32_t code, int32_t other)
{
    uint32_t distance = (uint32_t)llabs((long long)code - other);
    return distance > change ? distance : change;
}

/* Enter the change of one output. */
static void enter(struct witness_output *output, uint32_t number, int32_t code, uint64_t now_us)
{
    output->change = larger(output->change, code, output->code);
    for (uint64_t i = 0; i < HISTORY && i < witness->writes; i++) {
        uint64_t place = (witness->writes - i) % HISTORY;
        if (history[place].time_us + 1000 <= now_us) {
            break;
        }
        output->change_per_ms = larger(output->change_per_ms, code, history[place].codes[number]);
    }
    output->code = code;
}

void witness_write(const int32_t *codes, uint16_t digital, uint64_t now_us)
{
    if (witness == NULL) {
        return;
    }
    count();
    uint64_t place = witness->writes % HISTORY;
    history[place].time_us = now_us;
    for (uint32_t i = 0; i < witness->outputs; i++) {
        history[place].codes[i] = witness->output[i].code;
    }
    for (uint32_t i = 0; i < witness->outputs; i++) {
        if (witness->writes == 0) {
            witness->output[i].code = codes[i]; /* where the node starts is no change */
        }
        enter(&witness->output[i], i, codes[i], now_us);
    }
    witness->digital = digital;
    witness->writes++;
    count();
}

void witness_trips(uint32_t watchdog_trips)
{
    if (witness != NULL && witness->watchdog_trips != watchdog_trips) {
        count();
        witness->watchdog_trips = watchdog_trips;
        count();
    }
}

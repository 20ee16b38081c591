/* A simulated board for the node's library, for tests that call the library through ctypes. */
#include <stdlib.h>
#include <string.h>

#include "rtloop_cobs.h"
#include "rtloop_node.h"

enum { MOST_WRITES = 4096 };

/* A node, its configuration and its board; every write of the outputs is listed with the time of the node's clock. */
struct bench {
    struct rtloop_node node;
    struct rtloop_node_config config;
    struct rtloop_node_channel channels[RTLOOP_MAX_CHANNELS];
    uint8_t key[RTLOOP_KEY_BYTES];
    int32_t inputs[RTLOOP_MAX_CHANNELS];
    uint16_t digital_inputs;
    uint32_t reads;
    uint32_t writes;
    uint64_t clock_ns;
    uint64_t conversion_ns;       /* duration of a conversion */
    uint64_t times_us[MOST_WRITES];
    uint16_t digital[MOST_WRITES];
    int32_t codes[MOST_WRITES][RTLOOP_MAX_CHANNELS];
    uint32_t writes_at_read;      /* number of writes before the latest conversion */
};

static void read_inputs(void *context, int32_t *codes, uint16_t *digital)
{
    struct bench *bench = context;
    memcpy(codes, bench->inputs, bench->config.inputs * sizeof *codes);
    *digital = bench->digital_inputs;
    bench->clock_ns += bench->conversion_ns;
    bench->reads++;
    bench->writes_at_read = bench->writes;
}

static void write_outputs(void *context, const int32_t *codes, uint16_t digital)
{
    struct bench *bench = context;
    uint32_t place = bench->writes++ % MOST_WRITES;
    bench->times_us[place] = bench->node.now_us;
    bench->digital[place] = digital;
    memcpy(bench->codes[place], codes, bench->config.outputs * sizeof *codes);
}

static uint64_t now_ns(void *context)
{
    return ((struct bench *)context)->clock_ns;
}

struct bench *bench_new(void)
{
    return calloc(1, sizeof(struct bench));
}

void bench_delete(struct bench *bench)
{
    free(bench);
}

struct rtloop_node_channel *bench_channels(struct bench *bench)
{
    return bench->channels;
}

bool bench_start(struct bench *bench, const uint8_t counts[4], uint32_t longest_hold_us, uint32_t period_us, uint32_t boot,
                 const uint8_t *key, uint64_t now_us)
{
    if (key != NULL) {
        memcpy(bench->key, key, sizeof bench->key);
    }
    bench->config = (struct rtloop_node_config){
        .inputs = counts[0], .outputs = counts[1], .digital_inputs = counts[2], .digital_outputs = counts[3],
        .longest_hold_us = longest_hold_us, .shortest_period_us = period_us, .input = bench->channels,
        .key = key != NULL ? bench->key : NULL,
        .output = bench->channels + counts[0], .context = bench, .read_inputs = read_inputs,
        .write_outputs = write_outputs, .now_ns = now_ns};
    return rtloop_node_init(&bench->node, &bench->config, boot, now_us);
}

size_t bench_receive(struct bench *bench, const uint8_t *frame, size_t length, uint64_t sender, uint64_t now_us, uint8_t *answer)
{
    return rtloop_node_receive(&bench->node, frame, length, sender, now_us, answer);
}

void bench_poll(struct bench *bench, uint64_t now_us)
{
    rtloop_node_poll(&bench->node, now_us);
}

void bench_park(struct bench *bench, uint64_t now_us)
{
    rtloop_node_park(&bench->node, now_us);
}

uint64_t bench_due_us(struct bench *bench)
{
    return rtloop_node_due_us(&bench->node);
}

void bench_set_inputs(struct bench *bench, const int32_t *codes, uint16_t digital, uint64_t conversion_ns)
{
    memcpy(bench->inputs, codes, bench->config.inputs * sizeof *codes);
    bench->digital_inputs = digital;
    bench->conversion_ns = conversion_ns;
}

/* Fill invalid, old, refused, sessions, watchdog trips, foreign, reads, writes, writes before the latest conversion. */
void bench_counters(const struct bench *bench, uint32_t counters[9])
{
    memcpy(counters, &bench->node.counters, 6 * sizeof *counters);
    counters[6] = bench->reads;
    counters[7] = bench->writes;
    counters[8] = bench->writes_at_read;
}

/* Fill one write of the outputs, and return its time. */
uint64_t bench_write(const struct bench *bench, uint32_t number, int32_t *codes, uint16_t *digital)
{
    memcpy(codes, bench->codes[number % MOST_WRITES], bench->config.outputs * sizeof *codes);
    *digital = bench->digital[number % MOST_WRITES];
    return bench->times_us[number % MOST_WRITES];
}

uint64_t bench_extend_us(uint64_t previous_us, uint32_t clock_us)
{
    return rtloop_node_extend_us(previous_us, clock_us);
}

uint32_t bench_crc32(const uint8_t *bytes, size_t length)
{
    return rtloop_crc32(bytes, length);
}

uint64_t bench_siphash(const uint8_t *key, const uint8_t *bytes, size_t length)
{
    struct rtloop_siphash hash;
    rtloop_siphash_begin(&hash, key);
    rtloop_siphash_add(&hash, bytes, length);
    return rtloop_siphash_end(&hash);
}

size_t cobs_encode(const uint8_t *frame, size_t length, uint8_t *line)
{
    return rtloop_cobs_encode(frame, length, line);
}

struct rtloop_cobs *cobs_new(void)
{
    return calloc(1, sizeof(struct rtloop_cobs));
}

void cobs_delete(struct rtloop_cobs *receiver)
{
    free(receiver);
}

size_t cobs_receive(struct rtloop_cobs *receiver, uint8_t byte, uint8_t *frame)
{
    size_t length = rtloop_cobs_receive(receiver, byte);
    memcpy(frame, receiver->frame, length);
    return length;
}

uint32_t cobs_damaged(const struct rtloop_cobs *receiver)
{
    return receiver->damaged;
}

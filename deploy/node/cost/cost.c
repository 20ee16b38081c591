/* What the tag costs: an exchange and a WELCOME of a node with four inputs and four outputs, without and with a key.
 *
 * On a PC it prints ns. For a Cortex-M in QEMU it prints instructions: with `-icount shift=0` each one takes 1 ns of the machine's
 * time, by which SysTick counts down once per 40 ns. */
#include <stdio.h>
#include <string.h>

#include "rtloop_node.h"

enum { REPEATS = 2000, CHANNELS = 4 };

#ifdef __arm__
#define UNIT "instructions"
#define SYSTICK ((volatile uint32_t *)0xE000E010)
void _start(void);
__attribute__((section(".vectors"), used)) static void (*const vectors[2])(void) = {(void (*)(void))0x20100000, _start};
static uint32_t passed(void)
{
    static uint32_t last;
    uint32_t before = last;
    last = SYSTICK[2];
    return ((before - last) & 0xFFFFFFu) * 40;
}
#else
#include <time.h>
#define UNIT "ns"
static uint32_t passed(void)
{
    static struct timespec last;
    struct timespec before = last;
    clock_gettime(CLOCK_MONOTONIC, &last);
    return (uint32_t)((last.tv_sec - before.tv_sec) * 1000000000 + last.tv_nsec - before.tv_nsec);
}
#endif

static void read_inputs(void *context, int32_t *codes, uint16_t *digital)
{
    (void)context;
    memset(codes, 0, CHANNELS * sizeof *codes);
    *digital = 0;
}

static void write_outputs(void *context, const int32_t *codes, uint16_t digital)
{
    (void)context;
    (void)codes;
    (void)digital;
}

static const uint8_t key[RTLOOP_KEY_BYTES] = {1, 2, 3};
static struct rtloop_node_channel channels[RTLOOP_MAX_CHANNELS];
static struct rtloop_node node;
static uint8_t drive[RTLOOP_MAX_DRIVE];
static uint8_t answer[RTLOOP_NODE_MAX_ANSWER];

/* Write a DRIVE of the first session with a sequence, and return its length. */
static size_t make_drive(const uint8_t *own_key, uint8_t flags, uint32_t sequence)
{
    size_t length = 36 + 4 * CHANNELS;
    rtloop_frame_begin(drive, RTLOOP_DRIVE, sequence);
    rtloop_put32(drive + 8, 5);
    drive[12] = flags;
    drive[13] = CHANNELS;
    rtloop_put32(drive + 16, 1000);
    return rtloop_frame_seal(drive, length, own_key, (struct rtloop_course){.boot = 7});
}

/* Print the lowest cost of REPEATS exchanges, and of as many WELCOMEs. */
static void print_costs(const uint8_t *own_key, const uint8_t *hello, size_t hello_length)
{
    uint32_t exchange = UINT32_MAX;
    uint32_t welcome = UINT32_MAX;
    for (uint32_t i = 1; i <= REPEATS; i++) {
        size_t length = make_drive(own_key, i == 1 ? RTLOOP_OPEN : RTLOOP_APPLY | RTLOOP_ANSWER, i);
        passed();
        size_t answered = rtloop_node_receive(&node, drive, length, 0, i, answer);
        uint32_t cost = passed();
        exchange = answered != 0 && cost < exchange ? cost : exchange;
        rtloop_node_receive(&node, hello, hello_length, 0, i, answer);
        cost = passed();
        welcome = cost < welcome ? cost : welcome;
    }
    printf("%s key: an exchange %u %s, a WELCOME %u\n", own_key != NULL ? "with a" : "without", (unsigned)exchange, UNIT, (unsigned)welcome);
}

int main(void)
{
    struct rtloop_node_config config = {
        .inputs = CHANNELS, .outputs = CHANNELS, .longest_hold_us = 100000, .shortest_period_us = 100, .input = channels,
        .output = channels + CHANNELS, .read_inputs = read_inputs, .write_outputs = write_outputs};
    uint8_t hello[20];
    for (int i = 0; i < RTLOOP_MAX_CHANNELS; i++) {
        channels[i].change_per_ms = 1;
    }
    rtloop_frame_begin(hello, RTLOOP_HELLO, 0);
    rtloop_put32(hello + 12, RTLOOP_PROTOCOL_VERSION);
    rtloop_frame_end(hello, sizeof hello);
#ifdef __arm__
    SYSTICK[1] = 0xFFFFFF;
    SYSTICK[0] = 5;
#endif
    for (int keyed = 0; keyed < 2; keyed++) {
        config.key = keyed ? key : NULL;
        rtloop_node_init(&node, &config, 7, 0);
        print_costs(config.key, hello, sizeof hello);
    }
    return 0;
}

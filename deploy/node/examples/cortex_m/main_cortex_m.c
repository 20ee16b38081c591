/* A firmware in one file: what ties the library to a board, with stubs in place of the board.
 *
 * `make arm` compiles and links it, so that its size is known. It has run on no board. */
#include "rtloop_cobs.h"
#include "rtloop_node.h"

/* Replace the stubs by the board's functions. */
uint32_t board_clock_us(void);      /* a free-running clock of 32 bits that wraps */
uint32_t board_random(void);        /* never the same number twice: a generator in hardware, or a counter in flash */
extern const uint8_t board_key[RTLOOP_KEY_BYTES]; /* of this board and its loop alone, in flash that nobody reads out */
int board_take_byte(void);          /* a byte from the serial line; -1: none */
void board_send(const uint8_t *bytes, size_t length);
volatile int32_t board_dac;         /* in place of the DAC's register */
volatile int board_line = -1;       /* in place of the serial line's register */

static void read_inputs(void *context, int32_t *codes, uint16_t *digital)
{
    (void)context;
    codes[0] = 0; /* start the ADC, wait for it, read its code */
    *digital = 0;
}

static void write_outputs(void *context, const int32_t *codes, uint16_t digital)
{
    (void)context;
    (void)digital;
    board_dac = codes[0];
}

static const struct rtloop_node_channel input = {
    .lowest = -32768, .highest = 32767, .volts_per_code = 10.0 / 32768.0, .volts_at_zero = 0.0};
static const struct rtloop_node_channel output = {
    .lowest = -32768, .highest = 32767, .safe = 0, .change_per_ms = 33, .volts_per_code = 10.0 / 32768.0, .volts_at_zero = 0.0};
static const struct rtloop_node_config config = {
    .inputs = 1, .outputs = 1, .longest_hold_us = 100000, .shortest_period_us = 100, .input = &input, .output = &output, .key = board_key,
    .read_inputs = read_inputs, .write_outputs = write_outputs};

static struct rtloop_node node;
static struct rtloop_cobs line;
static uint8_t answer[RTLOOP_NODE_MAX_ANSWER];
static uint8_t coded[RTLOOP_COBS_SIZE(RTLOOP_NODE_MAX_ANSWER)];

/* Process the bytes that have come. */
static void serve(uint64_t now_us)
{
    for (int byte = board_take_byte(); byte >= 0; byte = board_take_byte()) {
        size_t length = rtloop_cobs_receive(&line, (uint8_t)byte);
        size_t answered = length != 0 ? rtloop_node_receive(&node, line.frame, length, 0, now_us, answer) : 0;
        if (answered != 0) {
            board_send(coded, rtloop_cobs_encode(answer, answered, coded));
        }
    }
}

int main(void)
{
    uint64_t now_us = board_clock_us();
    if (!rtloop_node_init(&node, &config, board_random(), now_us)) {
        return 1;
    }
    for (;;) {
        now_us = rtloop_node_extend_us(now_us, board_clock_us());
        rtloop_node_poll(&node, now_us);
        serve(now_us);
    }
}

/* The stubs: a line on which nothing comes, a clock that counts its calls, and a key with which no node starts. */
const uint8_t board_key[RTLOOP_KEY_BYTES] = {0};

uint32_t board_clock_us(void)
{
    static volatile uint32_t calls;
    return calls += 1;
}

uint32_t board_random(void)
{
    return 1;
}

int board_take_byte(void)
{
    return board_line;
}

void board_send(const uint8_t *bytes, size_t length)
{
    for (size_t i = 0; i < length; i++) {
        board_line = bytes[i];
    }
}

/* A simulated board: each input measures a resonator that the output of the same number drives.
 *
 *     x'' + 2 d w x' + w^2 x = w^2 g u        u, x in V; w = 2 pi f
 *
 * Between two calls u is constant, so that the solution is exact at any time. Codes have 16 bits over -10 V to 10 V. */
#include "board.h"

#include <math.h>
#include <string.h>
#include <time.h>

#include "option.h"

enum { MOST = RTLOOP_MAX_CHANNELS / 2, DIGITAL = 4 };

static const double volts_per_code = 10.0 / 32768.0;

static struct {
    double channels;
    double frequency_hz;
    double damping;
    double gain;
    double change;
    double hold_us;
    bool loopback;
} options = {.channels = 1, .frequency_hz = 300, .damping = 0.02, .gain = 1, .change = 330, .hold_us = 100000};

static struct {
    double volts;           /* x */
    double volts_per_s;     /* x' */
    double drive;           /* u */
} resonators[MOST];
static struct rtloop_node_channel inputs[MOST];
static struct rtloop_node_channel outputs[MOST];
static int32_t output_codes[MOST];
static uint16_t digital_outputs;
static double time_s;

const char board_help[] =
    "  --channels N      inputs, and outputs: 1 to 22 (1)\n"
    "  --frequency HZ    natural frequency of the resonator (300)\n"
    "  --damping D       its damping ratio, below 1 (0.02)\n"
    "  --gain G          V at the input per V at the output (1)\n"
    "  --loopback        input i is output i, without a resonator\n"
    "  --change CODES    largest change of an output in 1 ms of a ramp (330)\n"
    "  --hold US         longest time without a DRIVE (100000)\n";

int board_option(const char *name, const char *value)
{
    const struct {
        const char *name;
        double lowest;
        double highest;
        double *number;
    } numbers[] = {
        {"--channels", 1, MOST, &options.channels},    {"--frequency", 0.001, 1e6, &options.frequency_hz},
        {"--damping", 0, 0.999, &options.damping},     {"--gain", -1000, 1000, &options.gain},
        {"--change", 1, 65535, &options.change},       {"--hold", 1, 4e9, &options.hold_us},
    };
    for (size_t i = 0; i < sizeof numbers / sizeof *numbers; i++) {
        if (strcmp(name, numbers[i].name) == 0) {
            return option_number(name, value, numbers[i].lowest, numbers[i].highest, numbers[i].number) ? 2 : -1;
        }
    }
    if (strcmp(name, "--loopback") == 0) {
        options.loopback = true;
        return 1;
    }
    return 0;
}

/* Return the processor's time in s. */
static double clock_s(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

bool board_open(struct rtloop_node_config *config)
{
    uint8_t channels = (uint8_t)options.channels;
    for (int i = 0; i < channels; i++) {
        inputs[i] = (struct rtloop_node_channel){-32768, 32767, 0, 0, volts_per_code, 0.0};
        outputs[i] = (struct rtloop_node_channel){-32768, 32767, 0, (uint32_t)options.change, volts_per_code, 0.0};
    }
    config->inputs = config->outputs = channels;
    config->digital_inputs = config->digital_outputs = DIGITAL;
    config->longest_hold_us = (uint32_t)options.hold_us;
    config->shortest_period_us = 20;
    config->input = inputs;
    config->output = outputs;
    time_s = clock_s();
    return true;
}

/* Bring all resonators to the present. */
static void advance(void)
{
    double now_s = clock_s();
    double omega = 2.0 * acos(-1.0) * options.frequency_hz;
    double damped = omega * sqrt(1.0 - options.damping * options.damping);
    double decay = exp(-options.damping * omega * (now_s - time_s));
    double c = decay * cos(damped * (now_s - time_s));
    double s = decay * sin(damped * (now_s - time_s));
    for (int i = 0; i < (int)options.channels; i++) {
        double rest = options.gain * resonators[i].drive;
        double x = resonators[i].volts - rest;
        double v = resonators[i].volts_per_s;
        resonators[i].volts = rest + c * x + s * (v + options.damping * omega * x) / damped;
        resonators[i].volts_per_s = c * v - s * (omega * omega * x + options.damping * omega * v) / damped;
    }
    time_s = now_s;
}

void board_read(int32_t *codes, uint16_t *digital)
{
    *digital = digital_outputs;
    if (options.loopback) {
        memcpy(codes, output_codes, (size_t)options.channels * sizeof *codes);
        return;
    }
    advance();
    for (int i = 0; i < (int)options.channels; i++) {
        codes[i] = (int32_t)fmin(fmax(nearbyint(resonators[i].volts / volts_per_code), -32768.0), 32767.0);
    }
}

void board_write(const int32_t *codes, uint16_t digital)
{
    if (!options.loopback) {
        advance();
    }
    for (int i = 0; i < (int)options.channels; i++) {
        output_codes[i] = codes[i];
        resonators[i].drive = codes[i] * volts_per_code;
    }
    digital_outputs = digital;
}

/* A node as a Linux program: the library, a transport and a board. */
#include <errno.h>
#include <poll.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/random.h>
#include <time.h>

#include "board.h"
#include "key.h"
#include "option.h"
#include "transport.h"
#include "witness.h"

enum { FRAMES_AT_ONCE = 32 };

static const char help[] =
    "rtloop-node: a node of docs/node-protocol.md\n"
    "  --port N          UDP port, 0: a free one (5747)\n"
    "  --bind ADDRESS    own IPv4 or IPv6 address (all)\n"
    "  --tty PATH        a serial device instead of UDP\n"
    "  --pty LINK        a pseudo-terminal instead of UDP, and a symbolic link to it\n"
    "  --key FILE        32 hexadecimal digits that the loop has too; without, whoever reaches the node may drive it\n"
    "  --spin            never sleep: one processor for this program\n"
    "  --priority N      real-time priority, 1 to 99, and locked memory\n"
    "  --witness FILE    a file of the outputs for tests (linux/witness.h)\n";

static struct {
    double port;
    double priority;
    const char *bind;
    const char *tty;
    const char *pty;
    const char *key;
    const char *witness;
    bool spin;
} options = {.port = 5747};

static struct rtloop_node node;
static struct transport transport = {.other_end = -1};
static volatile sig_atomic_t stop_requested;

static void request_stop(int number)
{
    (void)number;
    stop_requested = 1;
}

/* Return CLOCK_MONOTONIC in ns. */
static uint64_t clock_ns(void *context)
{
    struct timespec now;
    (void)context;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

/* Return CLOCK_MONOTONIC in µs. */
static uint64_t clock_us(void)
{
    return clock_ns(NULL) / 1000;
}

static void read_inputs(void *context, int32_t *codes, uint16_t *digital)
{
    (void)context;
    board_read(codes, digital);
}

static void write_outputs(void *context, const int32_t *codes, uint16_t digital)
{
    (void)context;
    board_write(codes, digital);
    witness_write(codes, digital, node.now_us);
}

/* Take an option of the program; return as board_option does. */
static int program_option(const char *name, const char *value)
{
    const struct {
        const char *name;
        const char **text;
    } texts[] = {{"--bind", &options.bind}, {"--tty", &options.tty}, {"--pty", &options.pty}, {"--key", &options.key}, {"--witness", &options.witness}};
    for (size_t i = 0; i < sizeof texts / sizeof *texts; i++) {
        if (strcmp(name, texts[i].name) == 0) {
            if (value == NULL) {
                fprintf(stderr, "%s: value is missing\n", name);
                return -1;
            }
            *texts[i].text = value;
            return 2;
        }
    }
    if (strcmp(name, "--port") == 0) {
        return option_number(name, value, 0, 65535, &options.port) ? 2 : -1;
    }
    if (strcmp(name, "--priority") == 0) {
        return option_number(name, value, 1, 99, &options.priority) ? 2 : -1;
    }
    options.spin = options.spin || strcmp(name, "--spin") == 0;
    return strcmp(name, "--spin") == 0;
}

/* Read the command line; return false, after a message, if it is not allowed. */
static bool read_options(int argc, char **argv)
{
    for (int i = 1; i < argc;) {
        if (strcmp(argv[i], "--help") == 0) {
            printf("%s%s", help, board_help);
            exit(0);
        }
        int words = program_option(argv[i], argv[i + 1]);
        words = words == 0 ? board_option(argv[i], argv[i + 1]) : words;
        if (words == 0) {
            fprintf(stderr, "%s: is no option; --help lists them\n", argv[i]);
        }
        if (words <= 0) {
            return false;
        }
        i += words;
    }
    if (options.tty != NULL && options.pty != NULL) {
        fprintf(stderr, "--pty: value is %s; allowed: either --tty or --pty\n", options.pty);
        return false;
    }
    return true;
}

/* Take the real-time priority; return false, after a message, if the system refuses it. */
static bool take_priority(void)
{
    struct sched_param parameter = {.sched_priority = (int)options.priority};
    prctl(PR_SET_TIMERSLACK, 1ul, 0ul, 0ul, 0ul);
    if (options.priority == 0) {
        return true;
    }
    if (sched_setscheduler(0, SCHED_FIFO, &parameter) != 0 || mlockall(MCL_CURRENT | MCL_FUTURE) != 0) {
        fprintf(stderr, "--priority: %s; run as root, or with CAP_SYS_NICE and CAP_IPC_LOCK\n", strerror(errno));
        return false;
    }
    return true;
}

/* Have SIGINT and SIGTERM request a stop; without --spin they arrive in ppoll alone. */
static void catch_signals(sigset_t *while_waiting)
{
    struct sigaction action = {.sa_handler = request_stop};
    sigset_t stops;
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    sigemptyset(&stops);
    sigaddset(&stops, SIGINT);
    sigaddset(&stops, SIGTERM);
    sigprocmask(options.spin ? SIG_UNBLOCK : SIG_BLOCK, &stops, while_waiting);
    sigdelset(while_waiting, SIGINT);
    sigdelset(while_waiting, SIGTERM);
}

/* Open the board, the transport and the node; return false, after a message, if one fails. */
static bool start(struct rtloop_node_config *config)
{
    static uint8_t key[RTLOOP_KEY_BYTES];
    uint32_t boot = 0;
    if (options.key != NULL && !key_read(options.key, key)) {
        return false;
    }
    config->key = options.key != NULL ? key : NULL;
    if (!board_open(config) || (options.witness != NULL && !witness_open(options.witness, config->outputs))) {
        return false;
    }
    bool opened = options.tty != NULL   ? transport_open_tty(&transport, options.tty)
                  : options.pty != NULL ? transport_open_pty(&transport, options.pty)
                                        : transport_open_udp(&transport, options.bind, (uint16_t)options.port);
    if (!opened || !take_priority()) {
        return false;
    }
    if (getrandom(&boot, sizeof boot, 0) != sizeof boot) {
        fprintf(stderr, "boot: no random number: %s\n", strerror(errno));
        return false;
    }
    if (!rtloop_node_init(&node, config, boot, clock_us())) {
        fprintf(stderr, "the board's channels, or a key of 16 equal bytes, are not allowed; rtloop_node.h says what is\n");
        return false;
    }
    printf("{\"port\": %u, \"boot\": %u}\n", transport.port, boot);
    fflush(stdout);
    if (config->key == NULL) {
        fprintf(stderr, "no key: whoever reaches the node may drive it; --key FILE keeps others off\n");
    }
    return true;
}

/* Process the frames that have come, up to a number, so that signals are heard; return whether that was all of them. */
static bool exchange(void)
{
    uint8_t frame[TRANSPORT_BYTES];
    uint8_t answer[RTLOOP_NODE_MAX_ANSWER];
    uint64_t sender;
    for (int i = 0; i < FRAMES_AT_ONCE; i++) {
        ssize_t length = transport_receive(&transport, frame, &sender);
        if (length < 0) {
            return true;
        }
        size_t answered = rtloop_node_receive(&node, frame, (size_t)length, sender, clock_us(), answer);
        if (answered != 0) {
            transport_send(&transport, answer, answered);
        }
    }
    return false;
}

/* Sleep until a frame or a signal comes, or the node's next step is due. */
static void wait_for_work(bool parked, const sigset_t *while_waiting)
{
    struct pollfd ready = {.fd = transport.file, .events = POLLIN};
    uint64_t due_us = rtloop_node_due_us(&node);
    uint64_t now_us = clock_us();
    uint64_t rest_us = due_us > now_us ? due_us - now_us : 0;
    struct timespec rest = {.tv_sec = (time_t)(rest_us / 1000000), .tv_nsec = (long)(rest_us % 1000000) * 1000};
    ppoll(&ready, parked ? 0 : 1, due_us == UINT64_MAX ? NULL : &rest, while_waiting);
}

/* Run until a signal or the loss of the serial device, then until the outputs are at their safe codes. */
static void run(const sigset_t *while_waiting)
{
    bool parked = false;
    for (;;) {
        rtloop_node_poll(&node, clock_us());
        bool complete = parked || exchange();
        witness_trips(node.counters.watchdog_trips);
        if (!parked && (stop_requested || transport.lost)) {
            rtloop_node_park(&node, clock_us());
            parked = true;
        }
        if (parked && rtloop_node_at_safe(&node)) {
            return;
        }
        if (complete && !options.spin) {
            wait_for_work(parked, while_waiting);
        }
    }
}

int main(int argc, char **argv)
{
    struct rtloop_node_config config = {.read_inputs = read_inputs, .write_outputs = write_outputs, .now_ns = clock_ns};
    sigset_t while_waiting;
    if (!read_options(argc, argv)) {
        return 1;
    }
    catch_signals(&while_waiting);
    if (!start(&config)) {
        return 1;
    }
    run(&while_waiting);
    const struct rtloop_node_counters *counters = &node.counters;
    printf("{\"invalid\": %u, \"old\": %u, \"refused\": %u, \"sessions\": %u, \"watchdog_trips\": %u, \"foreign\": %u, \"damaged\": %u, \"unsent\": %u}\n",
           counters->invalid, counters->old, counters->refused, counters->sessions, counters->watchdog_trips,
           counters->foreign, transport.receiver.damaged, transport.unsent);
    transport_close(&transport);
    if (transport.lost) {
        fprintf(stderr, "--tty: %s: the device is gone\n", options.tty);
    }
    return transport.lost;
}

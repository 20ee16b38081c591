/* The loop's side in plain C, for a benchmark: opens a session, exchanges DRIVE and SAMPLE, and prints times as JSON.
 *
 * Outputs are held at their safe codes. Everything that can be computed before the first exchange is. */
#include <errno.h>
#include <netdb.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/random.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "key.h"
#include "option.h"
#include "rtloop_frame.h"

static const char help[] =
    "exchange HOST PORT: exchanges with a node over UDP\n"
    "  --count N         exchanges (10000)\n"
    "  --rate HZ         exchanges per second; 0: one after the other (1000)\n"
    "  --same-tick       ask for a sample, wait for it without sleep, then send the codes (the default)\n"
    "  --next-tick       send the codes; take the sample that answers them in the next tick\n"
    "  --hold US         hold of the node's watchdog (100000)\n"
    "  --key FILE        the node's key: 32 hexadecimal digits\n"
    "  --priority N      real-time priority, 1 to 99, and locked memory\n";

static struct {
    double count;
    double rate_hz;
    double hold_us;
    double priority;
    bool next_tick;
    const uint8_t *key;
} options = {.count = 10000, .rate_hz = 1000, .hold_us = 100000};

enum { LONGEST_WAIT_NS = 10000000, TRIES = 2000 };

static int file;
static uint8_t drive[RTLOOP_MAX_DRIVE];
static size_t drive_length;
static uint8_t answer[2048];
static uint32_t sequence;
static uint32_t session;
static struct rtloop_course course;

/* Return CLOCK_MONOTONIC in ns. */
static int64_t clock_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

/* Sleep until a time of CLOCK_MONOTONIC. */
static void sleep_until(int64_t time_ns)
{
    struct timespec deadline = {.tv_sec = time_ns / 1000000000, .tv_nsec = time_ns % 1000000000};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &deadline, NULL) == EINTR) {
    }
}

/* Print a message and end the program. */
static void fail(const char *what, const char *why)
{
    fprintf(stderr, "%s: %s\n", what, why);
    exit(1);
}

/* Send the prepared DRIVE with the next sequence. */
static void send_drive(void)
{
    rtloop_put32(drive + 4, ++sequence);
    rtloop_frame_seal(drive, drive_length, options.key, course);
    send(file, drive, drive_length, MSG_DONTWAIT);
}

/* Return whether the answer has the right tag, by the boot and opening in a WELCOME or REFUSAL; a REFUSAL must name the last DRIVE. */
static bool answer_tagged(size_t length)
{
    struct rtloop_course own = course;
    if (length < 44) {
        return answer[2] == RTLOOP_REFUSAL && rtloop_get16(answer + 16) == RTLOOP_VERSION;
    }
    if (answer[2] == RTLOOP_WELCOME) {
        own = (struct rtloop_course){.boot = rtloop_get32(answer + 20), .opening = rtloop_get32(answer + 36)};
    } else if (answer[2] == RTLOOP_REFUSAL) {
        own = (struct rtloop_course){.boot = rtloop_get32(answer + 12), .opening = rtloop_get32(answer + 20)};
    }
    bool mine = answer[2] != RTLOOP_REFUSAL || memcmp(answer + 24, drive + drive_length - RTLOOP_END_BYTES, 8) == 0;
    return mine && rtloop_frame_tagged(answer, length, options.key, own);
}

/* Take one frame if there is one; return whether it is a valid one of this session and of a format. A REFUSAL ends the program. */
static bool take(enum rtloop_format format)
{
    static const char *const reasons[] = {"?", "VERSION", "BUSY", "UNKNOWN", "WATCHDOG", "SIZE", "RANGE", "FLAGS"};
    ssize_t length = recv(file, answer, sizeof answer, MSG_DONTWAIT);
    if (length <= 0 || !rtloop_frame_valid(answer, (size_t)length) || rtloop_get32(answer + 8) != session
        || !answer_tagged((size_t)length)) {
        return false;
    }
    if (answer[2] == RTLOOP_REFUSAL) {
        fail("refused by the node", reasons[answer[16] < sizeof reasons / sizeof *reasons ? answer[16] : 0]);
    }
    return answer[2] == format;
}

/* Return whether a frame of a format comes within 10 ms. */
static bool wait_for(enum rtloop_format format)
{
    int64_t end_ns = clock_ns() + LONGEST_WAIT_NS;
    while (clock_ns() < end_ns) {
        if (take(format)) {
            return true;
        }
    }
    return false;
}

/* Connect the socket, so that neither a lookup nor an address is needed for each frame. */
static void connect_node(const char *host, const char *port)
{
    struct addrinfo hints = {.ai_socktype = SOCK_DGRAM};
    struct addrinfo *node = NULL;
    int fault = getaddrinfo(host, port, &hints, &node);
    if (fault != 0) {
        fail(host, gai_strerror(fault));
    }
    file = socket(node->ai_family, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    if (file < 0 || connect(file, node->ai_addr, node->ai_addrlen) != 0) {
        fail(host, strerror(errno));
    }
    freeaddrinfo(node);
}

/* Prepare the DRIVE from the node's WELCOME: every output at its safe code. */
static void prepare_drive(void)
{
    uint8_t inputs = answer[14];
    uint8_t outputs = answer[15];
    rtloop_frame_begin(drive, RTLOOP_DRIVE, 0);
    rtloop_put32(drive + 8, session);
    drive[13] = outputs;
    rtloop_put32(drive + 16, (uint32_t)options.hold_us);
    for (size_t i = 0; i < outputs; i++) {
        memcpy(drive + 24 + 4 * i, answer + 40 + 32 * (inputs + i) + 8, 4);
    }
    drive_length = 36 + 4 * (size_t)outputs;
}

/* Ask the node what it is, and prepare the DRIVE for it. */
static void greet(void)
{
    uint8_t hello[20];
    bool answered = false;
    rtloop_frame_begin(hello, RTLOOP_HELLO, 0);
    rtloop_put32(hello + 8, session);
    rtloop_put32(hello + 12, RTLOOP_PROTOCOL_VERSION);
    rtloop_frame_end(hello, sizeof hello);
    for (int i = 0; i < 100 && !answered; i++) {
        send(file, hello, sizeof hello, 0);
        answered = wait_for(RTLOOP_WELCOME);
    }
    if (!answered) {
        fail("node", options.key != NULL ? "no WELCOME with the key's tag within 1 s" : "no WELCOME within 1 s");
    }
    if ((options.key != NULL) != ((answer[32] & RTLOOP_KEYED) != 0)) {
        fail("--key", options.key != NULL ? "the node has no key" : "is missing: the node has a key");
    }
    course = (struct rtloop_course){.boot = rtloop_get32(answer + 20), .opening = rtloop_get32(answer + 36)};
    prepare_drive();
}

/* Greet the node, open the session, and wait for the end of the opening ramp. */
static void open_session(void)
{
    bool answered = false;
    bool ready = false;
    while (session == 0) {
        if (getrandom(&session, sizeof session, 0) != sizeof session) {
            fail("getrandom", strerror(errno));
        }
    }
    for (int i = 0; i < TRIES && !ready; i++) {
        if (!answered) {
            greet();
        }
        drive[12] = answered ? RTLOOP_ANSWER : RTLOOP_OPEN | RTLOOP_ANSWER;
        send_drive();
        if (wait_for(RTLOOP_SAMPLE)) {
            answered = true;
            ready = answer[16] & RTLOOP_READY;
        }
        usleep(1000);
    }
    if (!ready) {
        fail("node", "not READY");
    }
}

/* Park the session, and wait until the outputs are at their safe codes. */
static void park(void)
{
    drive[12] = RTLOOP_PARK | RTLOOP_ANSWER;
    for (int i = 0; i < TRIES; i++) {
        send_drive();
        if (wait_for(RTLOOP_SAMPLE) && answer[16] & RTLOOP_AT_SAFE) {
            return;
        }
        usleep(1000);
    }
    fail("node", "not AT_SAFE");
}

/* What the exchanges took: times in ns, and counts. */
static struct {
    float *answered_ns;
    float *calls_ns;
    size_t answered;
    size_t ticks;
    size_t late;
} figures;

static int64_t sent_ns[1 << 12]; /* by sequence */
static uint32_t opening;         /* sequence of the last DRIVE of the opening */

/* Take an answer, if one is there; return whether it answers the newest DRIVE. */
static bool take_sample(int64_t *now_ns)
{
    bool taken = take(RTLOOP_SAMPLE);
    *now_ns = clock_ns();
    if (!taken) {
        return false;
    }
    uint32_t answered = rtloop_get32(answer + 4);
    uint32_t behind = sequence - answered;
    if (behind < sequence - opening && behind < sizeof sent_ns / sizeof *sent_ns && figures.answered < (size_t)options.count) {
        figures.answered_ns[figures.answered++] = (float)(*now_ns - sent_ns[answered % (sizeof sent_ns / sizeof *sent_ns)]);
        figures.late += behind > (options.next_tick ? 1u : 0u);
    }
    return behind == 0;
}

/* Send a DRIVE with flags; return its time. */
static int64_t send_tick(uint8_t flags)
{
    int64_t now_ns = clock_ns();
    drive[12] = flags;
    sent_ns[(sequence + 1) % (sizeof sent_ns / sizeof *sent_ns)] = now_ns;
    send_drive();
    return now_ns;
}

/* Ask for a sample, wait for it at most until the end of its tick, and send the codes, which need no answer. */
static void tick_waiting(int64_t end_ns)
{
    int64_t now_ns;
    int64_t start_ns = send_tick(RTLOOP_ANSWER);
    while (!take_sample(&now_ns) && now_ns < end_ns) {
    }
    send_tick(RTLOOP_APPLY);
    figures.calls_ns[figures.ticks++] = (float)(clock_ns() - start_ns);
}

/* Take the answers that have come since the last tick, then send. */
static void tick_later(void)
{
    int64_t now_ns;
    int64_t start_ns = clock_ns();
    bool newest = false; /* nothing can be behind the answer to the newest DRIVE */
    for (size_t before = SIZE_MAX; before != figures.answered && !newest;) {
        before = figures.answered;
        newest = take_sample(&now_ns);
    }
    send_tick(RTLOOP_APPLY | RTLOOP_ANSWER);
    figures.calls_ns[figures.ticks++] = (float)(clock_ns() - start_ns);
}

/* Do all exchanges. */
static void run(void)
{
    int64_t period_ns = options.rate_hz > 0 ? (int64_t)(1e9 / options.rate_hz) : 0;
    int64_t due_ns = clock_ns() + period_ns;
    opening = sequence;
    for (size_t i = 0; i < (size_t)options.count; i++, due_ns += period_ns) {
        if (period_ns != 0) {
            sleep_until(due_ns);
        }
        if (options.next_tick) {
            tick_later();
        } else {
            tick_waiting(period_ns != 0 ? due_ns + period_ns : clock_ns() + LONGEST_WAIT_NS);
        }
    }
    int64_t now_ns = 0;
    for (int64_t end_ns = clock_ns() + LONGEST_WAIT_NS; now_ns < end_ns && !take_sample(&now_ns);) {
    }
}

static int compare(const void *a, const void *b)
{
    float x = *(const float *)a;
    float y = *(const float *)b;
    return (x > y) - (x < y);
}

/* Print the median, the 99th percentile and the maximum in µs. */
static void print_times(const char *name, float *times_ns, size_t count)
{
    if (count == 0) {
        printf("\"%s\": null, ", name);
        return;
    }
    qsort(times_ns, count, sizeof *times_ns, compare);
    printf("\"%s\": {\"p50\": %.2f, \"p99\": %.2f, \"max\": %.2f}, ", name, times_ns[count / 2] / 1e3, times_ns[count * 99 / 100] / 1e3,
           times_ns[count - 1] / 1e3);
}

/* Take an option; return how many words it has, 0 if it is not allowed. */
static int take_option(const char *name, const char *value)
{
    if (strcmp(name, "--same-tick") == 0 || strcmp(name, "--next-tick") == 0) {
        options.next_tick = name[2] == 'n';
        return 1;
    }
    static uint8_t key[RTLOOP_KEY_BYTES];
    if (strcmp(name, "--key") == 0 && value != NULL) {
        options.key = key;
        return key_read(value, key) ? 2 : 0;
    }
    const struct {
        const char *name;
        double lowest;
        double highest;
        double *number;
    } numbers[] = {{"--count", 1, 1e8, &options.count}, {"--rate", 0, 1e6, &options.rate_hz}, {"--hold", 1, 4e9, &options.hold_us}, {"--priority", 1, 99, &options.priority}};
    for (size_t i = 0; i < sizeof numbers / sizeof *numbers; i++) {
        if (strcmp(name, numbers[i].name) == 0) {
            return option_number(name, value, numbers[i].lowest, numbers[i].highest, numbers[i].number) ? 2 : 0;
        }
    }
    fprintf(stderr, "%s: is no option; --help lists them\n", name);
    return 0;
}

/* Take the real-time priority, and touch all memory once. */
static void prepare_process(void)
{
    struct sched_param parameter = {.sched_priority = (int)options.priority};
    prctl(PR_SET_TIMERSLACK, 1ul, 0ul, 0ul, 0ul);
    if (options.priority != 0 && (sched_setscheduler(0, SCHED_FIFO, &parameter) != 0 || mlockall(MCL_CURRENT | MCL_FUTURE) != 0)) {
        fail("--priority", strerror(errno));
    }
    size_t size = (size_t)options.count * sizeof(float);
    figures.answered_ns = malloc(size);
    figures.calls_ns = malloc(size);
    if (figures.answered_ns == NULL || figures.calls_ns == NULL) {
        fail("--count", strerror(errno));
    }
    memset(figures.answered_ns, 1, size);
    memset(figures.calls_ns, 1, size);
}

int main(int argc, char **argv)
{
    if (argc < 3 || strcmp(argv[1], "--help") == 0) {
        printf("%s", help);
        return argc < 3;
    }
    for (int i = 3; i < argc;) {
        int words = take_option(argv[i], argv[i + 1]);
        if (words == 0) {
            return 1;
        }
        i += words;
    }
    prepare_process();
    connect_node(argv[1], argv[2]);
    open_session();
    run();
    park();
    printf("{\"mode\": \"%s\", \"rate_hz\": %g, \"exchanges\": %zu, ", options.next_tick ? "next-tick" : "same-tick", options.rate_hz, figures.ticks);
    print_times("answer_us", figures.answered_ns, figures.answered);
    print_times("calls_us", figures.calls_ns, figures.ticks);
    printf("\"lost\": %zu, \"late\": %zu}\n", figures.ticks - figures.answered, figures.late);
    free(figures.answered_ns);
    free(figures.calls_ns);
    return 0;
}

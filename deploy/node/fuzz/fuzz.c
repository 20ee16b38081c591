/* Random datagrams through the library: mutations of valid frames, frames of other keys, recorded frames of earlier sessions and
 * boots, with a model of the rules that judges each outcome.
 *
 * Arguments: number of datagrams, seed, and `keyed` for a node with a key. The model reads frames by itself; it shares the functions
 * of check and tag alone, which the tests in Python compare with zlib's and with the paper's. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "../rtloop_cobs.h"
#include "../rtloop_node.h"

enum { INPUTS = 3, OUTPUTS = 2, DIGITAL = 5, SENDERS = 3, MEMORY = 64, LIBRARY = 4096, PERIOD_US = 50, LONGEST_HOLD_US = 20000, DRIVE_BYTES = 36 + 4 * OUTPUTS };

static const struct rtloop_node_channel input_channels[INPUTS] = {
    {-32768, 32767, 0, 0, 10.0 / 32768, 0.0}, {0, 65535, 0, 0, 1e-4, -1.0}, {INT32_MIN, INT32_MAX, 0, 0, 1.0, 0.0}};
static const struct rtloop_node_channel output_channels[OUTPUTS] = {
    {-32768, 32767, 0, 40, 10.0 / 32768, 0.0}, {100, 60000, 500, 7, 1e-4, 0.0}};

/* The outputs as the board sees them. */
static struct {
    int32_t codes[OUTPUTS];
    uint16_t digital;
    uint32_t writes;
    uint64_t now_us;
    uint64_t ramp_us;       /* time of the last step towards the safe codes */
    bool stepped;           /* the last change was such a step, so that 1 ms must pass before the next */
    bool may_follow;        /* the frame that is processed may set its codes */
    int32_t wanted[OUTPUTS];
    uint16_t wanted_digital;
    bool followed;
} board;

/* The session by the model's own account; its number and address are the node's. */
static struct {
    uint32_t boot;
    uint32_t openings;
    uint64_t newest;        /* sequence beyond 32 bits, from the OPEN on */
} model = {.boot = 7};

static struct rtloop_node node;
static uint64_t datagram;
static uint64_t state;

/* Stop with the number of the datagram if a fact does not hold. */
static void require(bool holds, const char *fact)
{
    if (!holds) {
        printf("datagram %llu: %s\n", (unsigned long long)datagram, fact);
        fflush(stdout);
        abort();
    }
}

/* Return the next random number (xorshift64*, Vigna 2016). */
static uint32_t draw(void)
{
    state ^= state >> 12;
    state ^= state << 25;
    state ^= state >> 27;
    return (uint32_t)((state * 2685821657736338717ull) >> 32);
}

/* Return a random number below a bound. */
static uint32_t below(uint32_t bound)
{
    return (uint32_t)(((uint64_t)draw() * bound) >> 32);
}

static void read_board(void *context, int32_t *codes, uint16_t *digital)
{
    (void)context;
    for (int i = 0; i < INPUTS; i++) {
        codes[i] = (int32_t)draw();
    }
    *digital = (uint16_t)draw();
}

/* Judge whether a write that is no frame's is one step of a ramp, or leaves the outputs where they are. */
static void judge_ramp(const int32_t *codes, uint16_t digital)
{
    bool moved = false;
    for (int i = 0; i < OUTPUTS; i++) {
        int64_t change = (int64_t)codes[i] - board.codes[i];
        int64_t way = (int64_t)output_channels[i].safe - board.codes[i];
        require(llabs(change) <= (int64_t)output_channels[i].change_per_ms, "a step of a ramp is too large");
        require(change == 0 || ((change > 0) == (way > 0) && llabs(change) <= llabs(way)), "a ramp leads away from safe");
        moved = moved || change != 0;
    }
    require(digital == 0, "a digital output is 1 in a ramp");
    require(!moved || !board.stepped || board.now_us - board.ramp_us >= 1000, "two steps of a ramp within 1 ms");
    if (moved) {
        board.ramp_us = board.now_us;
        board.stepped = true;
    }
}

static void write_board(void *context, const int32_t *codes, uint16_t digital)
{
    (void)context;
    bool follows = board.may_follow && memcmp(codes, board.wanted, sizeof board.wanted) == 0 && digital == board.wanted_digital;
    if (!follows && board.writes > 0) {
        judge_ramp(codes, digital);
    }
    board.followed = board.followed || follows;
    for (int i = 0; i < OUTPUTS; i++) {
        require(codes[i] >= output_channels[i].lowest && codes[i] <= output_channels[i].highest, "a code is out of range");
        board.codes[i] = codes[i];
    }
    require(digital >> DIGITAL == 0, "a digital output that does not exist is 1");
    board.digital = digital;
    board.writes++;
}

static const uint8_t key[RTLOOP_KEY_BYTES] = "a key of a loop";
static const uint8_t other_key[RTLOOP_KEY_BYTES] = "another's key..";
static struct rtloop_node_config config = {
    .inputs = INPUTS, .outputs = OUTPUTS, .digital_inputs = DIGITAL, .digital_outputs = DIGITAL,
    .longest_hold_us = LONGEST_HOLD_US, .shortest_period_us = PERIOD_US, .input = input_channels, .output = output_channels,
    .read_inputs = read_board, .write_outputs = write_board};

/* Senders, as a loop that behaves would be, and the last frames of all of them. */
static struct {
    uint32_t session;
    uint64_t sequence;
    uint32_t opening;
} loops[SENDERS];

/* Frames that were sent: the last ones, and a selection of all times, with their sender. */
struct recorded {
    uint8_t bytes[256];
    size_t length;
    uint64_t sender;
};
static struct recorded memory[MEMORY];
static struct recorded library[LIBRARY];

/* Write the next frame of a loop that behaves, and return its length. */
static size_t valid_frame(uint8_t *frame, uint32_t sender)
{
    uint32_t kind = below(64);
    uint64_t sequence = ++loops[sender].sequence;
    rtloop_frame_begin(frame, kind == 0 ? RTLOOP_HELLO : RTLOOP_DRIVE, (uint32_t)(sequence & UINT32_MAX));
    rtloop_put32(frame + 8, loops[sender].session);
    if (kind == 0) {
        rtloop_put32(frame + 12, 2);
        return rtloop_frame_end(frame, 20);
    }
    uint32_t act = RTLOOP_APPLY;
    if (kind == 1) {
        act = RTLOOP_PARK;
    } else if (kind < 10 || (node.session == 0 && kind < 32)) {
        act = node.session == 0 && below(4) != 0 ? RTLOOP_OPEN : below(8) == 0 ? RTLOOP_OPEN : 0;
    }
    if (act == RTLOOP_OPEN && node.session != loops[sender].session) {
        loops[sender].opening = model.openings;
        loops[sender].sequence &= UINT32_MAX;
    }
    frame[12] = (uint8_t)(act | (below(4) ? RTLOOP_ANSWER : 0));
    frame[13] = OUTPUTS;
    rtloop_put16(frame + 14, draw() & 0xFFFFu);
    rtloop_put32(frame + 16, below(100) ? 1 + below(30000) : 0);
    rtloop_put32(frame + 20, 0);
    for (int i = 0; i < OUTPUTS; i++) {
        const struct rtloop_node_channel *channel = &output_channels[i];
        int32_t width = below(4) ? 200 : channel->highest - channel->lowest;
        int32_t code = channel->safe + (int32_t)below((uint32_t)width) - width / 2;
        code = code < channel->lowest ? channel->lowest : code > channel->highest ? channel->highest : code;
        if (below(16) == 0) {
            code = below(2) ? channel->lowest : channel->highest;
        }
        rtloop_put32(frame + 24 + 4 * i, (uint32_t)code);
    }
    struct rtloop_course course = {model.boot, loops[sender].opening, (uint32_t)(loops[sender].sequence >> 32)};
    uint32_t *numbers[] = {&course.boot, &course.opening, &course.turn};
    if (below(32) == 0) {
        *numbers[below(3)] += below(2) ? 1 : UINT32_MAX;
    }
    return rtloop_frame_seal(frame, DRIVE_BYTES, below(32) ? config.key : other_key, course);
}

/* Change a frame at random, and return its new length. */
static size_t mutate(uint8_t *frame, size_t length, uint64_t *sender)
{
    static const uint8_t fields[] = {0, 2, 3, 4, 8, 12, 13, 14, 16, 20, 24, 28, 32, 36};
    uint32_t how = below(14);
    if (how == 0) {
        frame[below((uint32_t)length)] ^= (uint8_t)(1u << below(8));
    } else if (how == 1) {
        return below((uint32_t)length + 1);
    } else if (how <= 6) {
        size_t field = fields[below(sizeof fields)];
        uint32_t value = below(2) ? draw() : below(20);
        for (size_t i = field; i < field + 1 + below(4) && i < length - 4; i++) {
            frame[i] = (uint8_t)(value >> 8 * (i - field) & 0xFFu);
        }
        return rtloop_frame_end(frame, length);
    } else if (how == 7) {
        size_t extended = 20 + below(100);
        return rtloop_frame_end(frame, extended);
    } else if (how == 8) {
        *sender = below(SENDERS);
    } else if (how == 9 && length == DRIVE_BYTES) {
        rtloop_put32(frame + 4, rtloop_get32(frame + 4) + (1u << below(32)));
        struct rtloop_course course = {model.boot, loops[*sender].opening, (uint32_t)(loops[*sender].sequence >> 32)};
        return rtloop_frame_seal(frame, length, config.key, course);
    } else {
        const struct recorded *earlier = how < 12 ? &memory[below(MEMORY)] : &library[below(LIBRARY)];
        if (earlier->length != 0) {
            memcpy(frame, earlier->bytes, earlier->length);
            *sender = earlier->sender;
            return earlier->length;
        }
    }
    return length;
}

/* Return the sequence of a DRIVE beyond 32 bits: the first one from the newest on, if that is as near as a newer one may be. */
static uint64_t long_sequence(const uint8_t *frame)
{
    uint64_t sequence = (model.newest >> 32 << 32) + rtloop_get32(frame + 4);
    uint64_t next = sequence + (sequence > model.newest ? 0 : 1ull << 32);
    return next - model.newest <= 2000000 / PERIOD_US ? next : sequence;
}

/* Return whether a DRIVE has the tag that the document demands of one of the session that is open. */
static bool has_tag(const uint8_t *frame)
{
    struct rtloop_course course = {model.boot, model.openings - 1, (uint32_t)(long_sequence(frame) >> 32)};
    return config.key == NULL || rtloop_get64(frame + DRIVE_BYTES - 12) == rtloop_frame_tag(frame, DRIVE_BYTES, key, course);
}

/* Return whether a frame is a DRIVE whose content is allowed, with acts of OPEN, APPLY and PARK. */
static bool is_drive(const uint8_t *frame, size_t length, int acts)
{
    bool is_one = length == DRIVE_BYTES && frame[0] == 0x7B && frame[1] == 5 && frame[2] == 0x72 && frame[3] == 1
                  && rtloop_get32(frame + length - 4) == rtloop_crc32(frame, length - 4) && (frame[12] & 11) == acts
                  && frame[13] == OUTPUTS && rtloop_get32(frame + 16) != 0;
    for (int i = 0; is_one && i < OUTPUTS; i++) {
        int32_t code = (int32_t)rtloop_get32(frame + 24 + 4 * i);
        is_one = code >= output_channels[i].lowest && code <= output_channels[i].highest;
    }
    return is_one;
}

/* What the document says of a frame, from the session before it. */
static struct {
    bool opens;
    bool parks;
} expected;

/* Note whether a frame may set its codes, open a session, or must end the one that is open, and advance the newest sequence. */
static void expect(const uint8_t *frame, size_t length, uint64_t sender)
{
    bool alive = node.session != 0 && board.now_us < node.accepted_us + node.hold_us;
    bool own = alive && length == DRIVE_BYTES && rtloop_get32(frame + 8) == node.session && has_tag(frame);
    bool near = own && sender == node.sender && long_sequence(frame) - model.newest - 1 < 2000000 / PERIOD_US;
    struct rtloop_course next = {model.boot, model.openings, 0};
    expected.opens = !alive && is_drive(frame, length, RTLOOP_OPEN) && rtloop_get32(frame + 8) != 0
                     && (config.key == NULL || rtloop_get64(frame + length - 12) == rtloop_frame_tag(frame, length, key, next));
    expected.parks = own && is_drive(frame, length, RTLOOP_PARK) && (sender == node.sender || config.key != NULL);
    board.may_follow = near && is_drive(frame, length, RTLOOP_APPLY);
    for (int i = 0; board.may_follow && i < OUTPUTS; i++) {
        board.wanted[i] = (int32_t)rtloop_get32(frame + 24 + 4 * i);
    }
    board.wanted_digital = (uint16_t)(board.may_follow ? rtloop_get16(frame + 14) & 31u : 0);
    board.followed = false;
    if (expected.opens) {
        model.openings++;
        model.newest = rtloop_get32(frame + 4);
    } else if (near && (is_drive(frame, length, RTLOOP_APPLY) || is_drive(frame, length, RTLOOP_OPEN) || is_drive(frame, length, 0))) {
        model.newest = long_sequence(frame);
    } else if (expected.parks) {
        model.newest = long_sequence(frame);
    }
}

/* Judge the answer to a frame, and the session after it. */
static void judge(const uint8_t *frame, size_t frame_length, const uint8_t *answer, size_t length, const struct rtloop_node *before, bool ramping)
{
    require(length == 0 || length == 28 || length == 44 || length == 40 + 4 * INPUTS || length == 52 + 32 * (INPUTS + OUTPUTS),
            "an answer has a length that the protocol does not know");
    require(length == 0 || (rtloop_frame_valid(answer, length) && rtloop_get32(answer + 4) == rtloop_get32(frame + 4)),
            "an answer is not valid");
    bool refused = length != 0 && answer[2] == RTLOOP_REFUSAL;
    require(!refused || !board.followed, "a refused frame moved an output");
    require(!board.may_follow || board.followed || ramping, "an accepted APPLY moved no output");
    require(!(board.followed && ramping && node.ramping), "a frame moved an output in a ramp");
    require(node.counters.sessions == model.openings, "a session was opened by a frame that may not, or not by one that may");
    require(!expected.opens || node.session == rtloop_get32(frame + 8), "an OPEN opened no session");
    require(!expected.parks || node.session == 0, "a PARK of the session was not obeyed");
    require(node.session == 0 || node.newest == (uint32_t)(model.newest & UINT32_MAX), "another sequence is the newest one");
    require(!refused || length == 28 || memcmp(answer + 24, frame + frame_length - 12, 8) == 0, "a REFUSAL has another frame's tag");
    bool another = node.session != 0 && before->session != 0 && node.session != before->session;
    require(!another || board.now_us >= before->accepted_us + before->hold_us, "a session took another's place");
    require(node.session == 0 || node.hold_us <= LONGEST_HOLD_US, "a hold is too long");
    require(node.session == 0 || board.now_us < node.accepted_us + node.hold_us, "a session outlived its hold");
    require(memcmp(node.codes, board.codes, sizeof board.codes) == 0 && node.digital == board.digital, "a code was not written");
    require(node.ramping == (node.ramping && !rtloop_node_at_safe(&node)), "a ramp goes on at the safe codes");
}

/* Feed a frame, coded, with damage in between, to a receiver by bytes; an undamaged frame comes out as it went in. */
static void through_cobs(struct rtloop_cobs *receiver, const uint8_t *frame, size_t length)
{
    uint8_t line[RTLOOP_COBS_SIZE(256)];
    size_t size = rtloop_cobs_encode(frame, length, line);
    require(size <= RTLOOP_COBS_SIZE(length), "a coded frame is too long");
    require(memchr(line, 0, size) == line + size - 1, "a coded frame has a byte 0 inside");
    for (uint32_t i = below(4) ? 0 : below(2000); i > 0; i--) {
        rtloop_cobs_receive(receiver, (uint8_t)draw());
    }
    rtloop_cobs_receive(receiver, 0);
    size_t received = 0;
    for (size_t i = 0; i < size; i++) {
        received = rtloop_cobs_receive(receiver, line[i]);
        require(received == 0 || i == size - 1, "a frame ended early");
    }
    require(received == length && memcmp(receiver->frame, frame, length) == 0, "a frame was changed on the line");
}

/* Counters of all starts of the node. */
static struct rtloop_node_counters totals;

static void note_counters(void)
{
    totals.invalid += node.counters.invalid;
    totals.old += node.counters.old;
    totals.refused += node.counters.refused;
    totals.sessions += node.counters.sessions;
    totals.watchdog_trips += node.counters.watchdog_trips;
    totals.foreign += node.counters.foreign;
}

/* Start the node again, with a boot that it has not had. */
static void restart(void)
{
    for (int i = 0; i < OUTPUTS; i++) {
        board.codes[i] = output_channels[i].safe;
    }
    note_counters();
    board.stepped = false;
    model.boot++;
    model.openings = 0;
    require(rtloop_node_init(&node, &config, model.boot, board.now_us), "no start");
}

/* Process one random datagram. The frame and the answer end where their memory ends, so that any overrun is seen. */
static void run(uint8_t *frame_memory, uint8_t *answer, struct rtloop_cobs *receiver)
{
    uint8_t built[256] = {0};
    uint64_t sender = below(8) ? 0 : below(SENDERS);
    size_t length = valid_frame(built, (uint32_t)sender);
    if (below(3) == 0) {
        length = mutate(built, length, &sender);
    }
    memcpy(memory[datagram % MEMORY].bytes, built, length);
    memory[datagram % MEMORY].length = length;
    memory[datagram % MEMORY].sender = sender;
    if (below(16) == 0) {
        library[below(LIBRARY)] = memory[datagram % MEMORY];
    }
    uint8_t *frame = frame_memory + sizeof built - length;
    memcpy(frame, built, length);
    board.now_us += below(200) ? below(400) : below(60000);
    const struct rtloop_node before = node;
    expect(frame, length, sender);
    size_t answered = rtloop_node_receive(&node, frame, length, sender, board.now_us, answer);
    judge(frame, length, answer, answered, &before, before.ramping);
    board.may_follow = false;
    if (below(1000) == 0) {
        loops[below(SENDERS)].session = below(16) ? draw() : 0;
    }
    if (below(2000) == 0) {
        loops[below(SENDERS)].sequence = 0xFFFFFFF0u;
    }
    if (config.key != NULL && below(20000) == 0) {
        restart();
    }
    if (datagram % 16 == 0 && length > 0) {
        through_cobs(receiver, frame, length);
    }
}

int main(int argc, char **argv)
{
    uint64_t count = argc > 1 ? strtoull(argv[1], NULL, 10) : 100000;
    state = argc > 2 ? strtoull(argv[2], NULL, 10) : 1;
    config.key = argc > 3 ? key : NULL;
    uint8_t *frame = malloc(256);
    uint8_t *answer = malloc(52 + 32 * (INPUTS + OUTPUTS));
    struct rtloop_cobs *receiver = calloc(1, sizeof *receiver);
    require(frame != NULL && answer != NULL && receiver != NULL && rtloop_node_init(&node, &config, model.boot, 0), "no start");
    clock_t start = clock();
    for (datagram = 0; datagram < count; datagram++) {
        run(frame, answer, receiver);
    }
    double seconds = (double)(clock() - start) / CLOCKS_PER_SEC;
    note_counters();
    printf("{\"datagrams\": %llu, \"keyed\": %s, \"per_second\": %.0f, \"sessions\": %u, \"watchdog_trips\": %u, \"old\": %u, \"refused\": %u, "
           "\"invalid\": %u, \"foreign\": %u, \"writes\": %u}\n", (unsigned long long)count, config.key != NULL ? "true" : "false",
           (double)count / seconds, totals.sessions, totals.watchdog_trips, totals.old, totals.refused, totals.invalid, totals.foreign,
           board.writes);
    free(frame);
    free(answer);
    free(receiver);
    return 0;
}

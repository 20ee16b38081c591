#include "rtloop_node.h"

#include <string.h>

_Static_assert(sizeof(double) == 8, "a channel's constants are numbers of 64 bits");

/* Time between two steps of a ramp. */
#define STEP_US 1000u

/* Twice the µs of a second: a DRIVE that is further ahead than a second with two frames in a period is no newer frame. */
#define WINDOW_US 2000000u

/* Return whether a description of channels is allowed. */
static bool channels_allowed(const struct rtloop_node_channel *channels, uint8_t count, bool outputs)
{
    for (uint8_t i = 0; i < count; i++) {
        const struct rtloop_node_channel *channel = &channels[i];
        bool safe_allowed = channel->lowest <= channel->safe && channel->safe <= channel->highest;
        if (channel->lowest > channel->highest || (outputs && (!safe_allowed || channel->change_per_ms == 0))) {
            return false;
        }
    }
    return true;
}

/* Return whether a key is more than a memory that nobody has written: bytes that are all equal. */
static bool key_allowed(const uint8_t *key)
{
    uint8_t differences = 0;
    for (int i = 1; key != NULL && i < RTLOOP_KEY_BYTES; i++) {
        differences |= key[i] ^ key[0];
    }
    return key == NULL || differences != 0;
}

/* Return whether a configuration describes a node that the protocol allows. */
static bool config_allowed(const struct rtloop_node_config *config)
{
    return config->inputs >= 1 && config->outputs >= 1 && config->inputs + config->outputs <= RTLOOP_MAX_CHANNELS
           && config->digital_inputs <= RTLOOP_MAX_DIGITAL && config->digital_outputs <= RTLOOP_MAX_DIGITAL
           && config->longest_hold_us >= 1 && key_allowed(config->key) && channels_allowed(config->input, config->inputs, false)
           && channels_allowed(config->output, config->outputs, true);
}

/* Return the bits of digital channels that exist. */
static uint16_t digital_bits(uint16_t bits, uint8_t count)
{
    return (uint16_t)(bits & ((1ul << count) - 1ul));
}

/* Pass the node's codes to the board. */
static void write_outputs(const struct rtloop_node *node)
{
    node->config->write_outputs(node->config->context, node->codes, node->digital);
}

/* Advance the node's time; a clock that steps back is taken to stand still. */
static void advance(struct rtloop_node *node, uint64_t now_us)
{
    if (now_us > node->now_us) {
        node->now_us = now_us;
    }
}

bool rtloop_node_at_safe(const struct rtloop_node *node)
{
    for (uint8_t i = 0; i < node->config->outputs; i++) {
        if (node->codes[i] != node->config->output[i].safe) {
            return false;
        }
    }
    return true;
}

bool rtloop_node_init(struct rtloop_node *node, const struct rtloop_node_config *config, uint32_t boot, uint64_t now_us)
{
    if (!config_allowed(config)) {
        return false;
    }
    memset(node, 0, sizeof *node);
    node->config = config;
    node->boot = boot;
    node->now_us = now_us;
    for (uint8_t i = 0; i < config->outputs; i++) {
        node->codes[i] = config->output[i].safe;
    }
    write_outputs(node);
    return true;
}

/* Set the digital outputs to 0, and begin to ramp the others to their safe codes; a ramp that runs goes on. */
static void begin_ramp(struct rtloop_node *node)
{
    if (node->ramping) {
        return;
    }
    node->digital = 0;
    node->applied = 0;
    node->ramping = !rtloop_node_at_safe(node);
    node->step_us = node->now_us + STEP_US;
    write_outputs(node);
}

/* Return the code that is one step of the ramp nearer to the safe code. */
static int32_t ramped(int32_t code, const struct rtloop_node_channel *channel)
{
    int64_t way = (int64_t)channel->safe - code;
    int64_t change = (int64_t)channel->change_per_ms;
    if (way > change) {
        way = change;
    } else if (way < -change) {
        way = -change;
    }
    return (int32_t)(code + way);
}

/* Take the step of the ramp that is due. A late step is not made up for: the next one is due 1 ms after it. */
static void step_ramp(struct rtloop_node *node)
{
    for (uint8_t i = 0; i < node->config->outputs; i++) {
        node->codes[i] = ramped(node->codes[i], &node->config->output[i]);
    }
    node->step_us = node->now_us + STEP_US;
    node->ramping = !rtloop_node_at_safe(node);
    write_outputs(node);
}

/* End the session because its loop was not heard in time. */
static void trip(struct rtloop_node *node)
{
    node->counters.watchdog_trips++;
    node->tripped_session = node->session;
    if (node->parked_session == node->session) {
        node->parked_session = 0;
    }
    node->session = 0;
    begin_ramp(node);
}

void rtloop_node_poll(struct rtloop_node *node, uint64_t now_us)
{
    advance(node, now_us);
    if (node->session != 0 && node->now_us - node->accepted_us >= node->hold_us) {
        trip(node);
    }
    if (node->ramping && node->now_us >= node->step_us) {
        step_ramp(node);
    }
}

void rtloop_node_park(struct rtloop_node *node, uint64_t now_us)
{
    rtloop_node_poll(node, now_us);
    node->session = 0;
    begin_ramp(node);
}

uint64_t rtloop_node_due_us(const struct rtloop_node *node)
{
    uint64_t due_us = node->ramping ? node->step_us : UINT64_MAX;
    uint64_t trip_us = node->accepted_us + node->hold_us;
    return node->session != 0 && trip_us < due_us ? trip_us : due_us;
}

/* Return the course of a frame of this boot. */
static struct rtloop_course course(const struct rtloop_node *node, uint32_t opening, uint32_t turn)
{
    return (struct rtloop_course){.boot = node->boot, .opening = opening, .turn = turn};
}

/* Write a REFUSAL of a HELLO or DRIVE, and return its length. */
static size_t refuse(struct rtloop_node *node, const uint8_t *frame, size_t length, enum rtloop_reason reason, uint8_t *answer)
{
    node->counters.refused++;
    rtloop_frame_begin(answer, RTLOOP_REFUSAL, rtloop_get32(frame + 4));
    rtloop_put32(answer + 8, rtloop_get32(frame + 8));
    rtloop_put32(answer + 12, node->boot);
    rtloop_put16(answer + 16, (uint32_t)reason);
    rtloop_put16(answer + 18, RTLOOP_PROTOCOL_VERSION);
    if (reason == RTLOOP_VERSION) {
        rtloop_put32(answer + 20, 0);
        return rtloop_frame_end(answer, 28);
    }
    rtloop_put32(answer + 20, node->counters.sessions);
    memcpy(answer + 24, frame + length - RTLOOP_END_BYTES, 8);
    return rtloop_frame_seal(answer, 44, node->config->key, course(node, node->counters.sessions, 0));
}

/* Copy the 64 bits of a number to eight bytes. */
static void put_double(uint8_t *bytes, const double *number)
{
    uint64_t bits;
    memcpy(&bits, number, sizeof bits);
    rtloop_put64(bytes, bits);
}

/* Write the description of channels, and return the place behind it. */
static uint8_t *put_channels(uint8_t *bytes, const struct rtloop_node_channel *channels, uint8_t count, bool outputs)
{
    for (uint8_t i = 0; i < count; i++, bytes += 32) {
        rtloop_put32(bytes, (uint32_t)channels[i].lowest);
        rtloop_put32(bytes + 4, (uint32_t)channels[i].highest);
        rtloop_put32(bytes + 8, outputs ? (uint32_t)channels[i].safe : 0);
        rtloop_put32(bytes + 12, outputs ? channels[i].change_per_ms : 0);
        put_double(bytes + 16, &channels[i].volts_per_code);
        put_double(bytes + 24, &channels[i].volts_at_zero);
    }
    return bytes;
}

/* Return whether a number is that of the session that is open. */
static bool is_own(const struct rtloop_node *node, uint32_t session)
{
    return node->session != 0 && session == node->session;
}

/* Answer a HELLO by a WELCOME, or by a REFUSAL if it has another version, and return the answer's length. */
static size_t receive_hello(struct rtloop_node *node, const uint8_t *frame, size_t length, uint8_t *answer)
{
    const struct rtloop_node_config *config = node->config;
    uint32_t opening = node->counters.sessions - is_own(node, rtloop_get32(frame + 8));
    if (rtloop_get16(frame + 12) != RTLOOP_PROTOCOL_VERSION) {
        return refuse(node, frame, length, RTLOOP_VERSION, answer);
    }
    rtloop_frame_begin(answer, RTLOOP_WELCOME, rtloop_get32(frame + 4));
    rtloop_put32(answer + 8, rtloop_get32(frame + 8));
    rtloop_put16(answer + 12, RTLOOP_PROTOCOL_VERSION);
    answer[14] = config->inputs;
    answer[15] = config->outputs;
    answer[16] = config->digital_inputs;
    answer[17] = config->digital_outputs;
    rtloop_put16(answer + 18, 0);
    rtloop_put32(answer + 20, node->boot);
    rtloop_put32(answer + 24, config->longest_hold_us);
    rtloop_put32(answer + 28, config->shortest_period_us);
    rtloop_put32(answer + 32, (node->session != 0 ? RTLOOP_DRIVEN : 0u) | (config->key != NULL ? RTLOOP_KEYED : 0u));
    rtloop_put32(answer + 36, opening);
    uint8_t *end = put_channels(answer + 40, config->input, config->inputs, false);
    end = put_channels(end, config->output, config->outputs, true);
    return rtloop_frame_seal(answer, (size_t)(end - answer) + RTLOOP_END_BYTES, config->key, course(node, opening, 0));
}

/* A DRIVE, read from its bytes. */
struct drive {
    uint32_t sequence;
    uint32_t session;
    uint32_t hold_us;
    uint16_t digital;
    uint8_t flags;
    uint8_t outputs;
    const uint8_t *codes;
    bool newer;                   /* than the newest one of the session */
    struct rtloop_course course;  /* that its tag must have */
};

/* Return whether a DRIVE is of the session that is open, or parks once more the session that was parked last. */
static bool is_of_session(const struct rtloop_node *node, const struct drive *drive)
{
    bool parks_again = node->session == 0 && drive->flags & RTLOOP_PARK && drive->session == node->parked_session;
    return drive->session != 0 && (parks_again || is_own(node, drive->session));
}

/* Return whether a sequence is newer than the newest one (rule 4). */
static bool is_newer(const struct rtloop_node *node, uint32_t sequence)
{
    uint32_t window = WINDOW_US / (node->config->shortest_period_us != 0 ? node->config->shortest_period_us : 1);
    return sequence - node->newest - 1 < (window > 2 ? window : 2);
}

static struct drive read_drive(const struct rtloop_node *node, const uint8_t *frame)
{
    struct drive drive = {
        .sequence = rtloop_get32(frame + 4),
        .session = rtloop_get32(frame + 8),
        .flags = frame[12],
        .outputs = frame[13],
        .digital = rtloop_get16(frame + 14),
        .hold_us = rtloop_get32(frame + 16),
        .codes = frame + 24,
    };
    drive.newer = is_newer(node, drive.sequence);
    drive.course = is_of_session(node, &drive)
                       ? course(node, node->counters.sessions - 1, node->turn + (drive.newer && drive.sequence < node->newest))
                       : course(node, node->counters.sessions, 0);
    return drive;
}

/* Return why a DRIVE from an address has no access to the node (rules 3, 5 and 9); 0 if it has.
 * With a key the tag of a PARK is enough, so that no other address keeps a loop from parking. */
static enum rtloop_reason judge_access(const struct rtloop_node *node, const struct drive *drive, uint64_t sender)
{
    bool from_any = node->config->key != NULL && drive->flags & RTLOOP_PARK;
    if (node->session != 0) {
        return is_own(node, drive->session) && (from_any || sender == node->sender) ? 0 : RTLOOP_BUSY;
    }
    if (drive->session == 0) {
        return RTLOOP_UNKNOWN;
    }
    if (drive->flags & RTLOOP_OPEN || (is_of_session(node, drive) && (from_any || sender == node->parked_sender))) {
        return 0;
    }
    return drive->session == node->tripped_session ? RTLOOP_WATCHDOG : RTLOOP_UNKNOWN;
}

/* Return whether a DRIVE, which `reason` would refuse, is foreign to a node with a key.
 * All are told UNKNOWN and WATCHDOG, so that a node that has started again can tell its loop. A copy of a loop's DRIVE from another
 * address is not told BUSY, which the loop would believe. */
static bool is_foreign(const struct rtloop_node *node, const struct drive *drive, enum rtloop_reason reason, const uint8_t *frame,
                       size_t length)
{
    if (node->config->key == NULL || reason == RTLOOP_UNKNOWN || reason == RTLOOP_WATCHDOG) {
        return false;
    }
    bool copied = reason == RTLOOP_BUSY && drive->session == node->session;
    return copied || !rtloop_frame_tagged(frame, length, node->config->key, drive->course);
}

/* Return whether a DRIVE of the session comes too late (rule 4). A PARK is obeyed whatever its sequence. */
static bool is_old(const struct rtloop_node *node, const struct drive *drive)
{
    return node->session != 0 && !drive->newer && !(drive->flags & RTLOOP_PARK);
}

/* Return why the content of a DRIVE is not allowed (rule 6); 0 if it is. */
static enum rtloop_reason judge_content(const struct rtloop_node *node, const struct drive *drive)
{
    if (drive->outputs != node->config->outputs) {
        return RTLOOP_SIZE;
    }
    for (uint8_t i = 0; i < drive->outputs; i++) {
        int32_t code = rtloop_get_code(drive->codes + 4 * i);
        if (code < node->config->output[i].lowest || code > node->config->output[i].highest) {
            return RTLOOP_RANGE;
        }
    }
    uint8_t acts = drive->flags & (RTLOOP_OPEN | RTLOOP_APPLY | RTLOOP_PARK);
    return drive->hold_us == 0 || (acts & (acts - 1)) != 0 ? RTLOOP_FLAGS : 0;
}

/* Open the session of a DRIVE, or begin its opening anew. */
static void open_session(struct rtloop_node *node, const struct drive *drive, uint64_t sender)
{
    if (node->session == 0) {
        node->counters.sessions++;
    }
    node->session = drive->session;
    node->sender = sender;
    begin_ramp(node);
}

/* End the session by its loop's wish. */
static void park_session(struct rtloop_node *node)
{
    node->parked_session = node->session;
    node->parked_sender = node->sender;
    if (node->tripped_session == node->session) {
        node->tripped_session = 0;
    }
    node->session = 0;
    begin_ramp(node);
}

/* Set the outputs to the codes of a DRIVE. */
static void apply(struct rtloop_node *node, const struct drive *drive)
{
    for (uint8_t i = 0; i < drive->outputs; i++) {
        node->codes[i] = rtloop_get_code(drive->codes + 4 * i);
    }
    node->digital = digital_bits(drive->digital, node->config->digital_outputs);
    node->applied = drive->sequence;
    write_outputs(node);
}

/* Do what an accepted DRIVE says to the session and the outputs. */
static void obey(struct rtloop_node *node, const struct drive *drive, uint64_t sender)
{
    if (drive->flags & RTLOOP_OPEN) {
        open_session(node, drive, sender);
    }
    if (node->session == 0) {
        return; /* a repeated PARK */
    }
    node->newest = drive->sequence;
    node->turn = drive->course.turn;
    node->accepted_us = node->now_us;
    node->hold_us = drive->hold_us < node->config->longest_hold_us ? drive->hold_us : node->config->longest_hold_us;
    if (drive->flags & RTLOOP_PARK) {
        park_session(node);
    } else if (drive->flags & RTLOOP_APPLY && !node->ramping) {
        apply(node, drive);
    }
}

/* Return the board's clock in ns; 0 for a board without one. */
static uint64_t board_ns(const struct rtloop_node *node)
{
    return node->config->now_ns != NULL ? node->config->now_ns(node->config->context) : 0;
}

/* Convert the inputs, and write their part of a SAMPLE. */
static void put_inputs(const struct rtloop_node *node, uint8_t *answer)
{
    const struct rtloop_node_config *config = node->config;
    int32_t codes[RTLOOP_MAX_CHANNELS] = {0};
    uint16_t digital = 0;
    config->read_inputs(config->context, codes, &digital);
    answer[17] = config->inputs;
    rtloop_put16(answer + 18, digital_bits(digital, config->digital_inputs));
    for (uint8_t i = 0; i < config->inputs; i++) {
        rtloop_put32(answer + 28 + 4 * i, (uint32_t)codes[i]);
    }
}

/* Complete the SAMPLE that answers a DRIVE, converted at a time of the board's clock, and return its length. */
static size_t end_sample(const struct rtloop_node *node, const struct drive *drive, uint64_t converted_ns, uint8_t *answer)
{
    bool ready = node->session != 0 && !node->ramping;
    rtloop_frame_begin(answer, RTLOOP_SAMPLE, drive->sequence);
    rtloop_put32(answer + 8, drive->session);
    rtloop_put32(answer + 12, node->boot);
    answer[16] = (uint8_t)((ready ? RTLOOP_READY : 0) | (rtloop_node_at_safe(node) ? RTLOOP_AT_SAFE : 0));
    rtloop_put32(answer + 24, node->applied);
    uint64_t age_ns = board_ns(node) - converted_ns;
    rtloop_put32(answer + 20, age_ns < UINT32_MAX ? (uint32_t)age_ns : UINT32_MAX);
    return rtloop_frame_seal(answer, 40 + 4 * (size_t)node->config->inputs, node->config->key, drive->course);
}

/* Process a DRIVE, and return the length of its answer; 0: none. */
static size_t receive_drive(struct rtloop_node *node, const uint8_t *frame, size_t length, uint64_t sender, uint8_t *answer)
{
    struct drive drive = read_drive(node, frame);
    enum rtloop_reason reason = judge_access(node, &drive, sender);
    if (is_foreign(node, &drive, reason, frame, length)) {
        node->counters.foreign++;
        return 0;
    }
    if (reason == 0 && is_old(node, &drive)) {
        node->counters.old++;
        return 0;
    }
    if (reason == 0) {
        reason = judge_content(node, &drive);
    }
    if (reason != 0) {
        return refuse(node, frame, length, reason, answer);
    }
    uint64_t converted_ns = board_ns(node);
    if (drive.flags & RTLOOP_ANSWER) {
        put_inputs(node, answer);
    }
    obey(node, &drive, sender);
    return drive.flags & RTLOOP_ANSWER ? end_sample(node, &drive, converted_ns, answer) : 0;
}

size_t rtloop_node_receive(struct rtloop_node *node, const uint8_t *frame, size_t length, uint64_t sender, uint64_t now_us,
                           uint8_t answer[RTLOOP_NODE_MAX_ANSWER])
{
    rtloop_node_poll(node, now_us); /* a hold that has passed ends the session before this frame */
    if (rtloop_frame_valid(frame, length)) {
        if (frame[2] == RTLOOP_HELLO && length == 20) {
            return receive_hello(node, frame, length, answer);
        }
        if (frame[2] == RTLOOP_DRIVE && length == 36 + 4 * (size_t)frame[13]) {
            return receive_drive(node, frame, length, sender, answer);
        }
    }
    node->counters.invalid++;
    return 0;
}

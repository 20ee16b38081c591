/* Rings, events and commands, as rtloop.engine has them. Coefficients that are loaded while the loop runs end the
 * program: no benchmark loads any. */
#pragma once
#include <stdatomic.h>
#include "step.h"

enum { COMMANDS_PER_TICK = 4, ALL_AXES = -1 };
typedef struct loop *loop_p;
typedef _Atomic uint64_t *word_p;

static inline law_p law_of(loop_p loop) { return (law_p)at(loop->law); }
static inline word_p words_of(loop_p loop) { return (word_p)at(loop->words); }
static inline uint64_t load(word_p word) { return atomic_load_explicit(word, memory_order_acquire); }
static inline void store(word_p word, uint64_t value) { atomic_store_explicit(word, value, memory_order_release); }

static inline uint64_t claim(int64_t marks, unsigned capacity, int64_t position) {
    uint64_t slot = (uint64_t)position & (capacity - 1);
    store((word_p)at(marks) + slot, UINT64_MAX);
    atomic_thread_fence(memory_order_release);
    return slot;
}
static inline void publish(int64_t head, int64_t marks, unsigned capacity, int64_t position) {
    uint64_t slot = (uint64_t)position & (capacity - 1);
    store((word_p)at(marks) + slot, (uint64_t)position + 1);
    store((word_p)at(head), (uint64_t)position + 1);
}

static void publish_event(
    loop_p loop, int64_t kind, int64_t axis, int64_t origin, int64_t identity, const double *values, int64_t count
) {
    struct message *event = (struct message *)at(loop->events_slots);
    event += claim(loop->events_marks, loop->events_capacity, loop->events);
    *event = (struct message){.tick = loop->tick, .kind = kind, .axis = axis, .origin = origin, .identity = identity};
    memcpy(event->values, values, (size_t)count * sizeof *values);
    publish(loop->events_head, loop->events_marks, loop->events_capacity, loop->events++);
}

static void publish_snapshot(loop_p loop) {
    law_p law = law_of(loop);
    char *slot = at(loop->snapshots_slots);
    slot += claim(loop->snapshots_marks, loop->snapshots_capacity, loop->snapshots) * loop->snapshot_bytes;
    size_t coefficients = law->axis_count * (size_t)law->coefficients_bytes;
    size_t axes = law->axis_count * (size_t)law->axes_bytes;
    if (sizeof loop->tick + coefficients + axes + sizeof(struct loop_state) > loop->snapshot_bytes) abort();
    memcpy(slot, &loop->tick, sizeof loop->tick);
    memcpy(slot += sizeof loop->tick, at(law->coefficients), coefficients);
    memcpy(slot += coefficients, at(law->axes), axes);
    memcpy(slot + axes, loop_of(law), sizeof(struct loop_state));
    publish(loop->snapshots_head, loop->snapshots_marks, loop->snapshots_capacity, loop->snapshots++);
}

static void change_units(loop_p loop, int64_t mode, bool holds_output) {
    struct generator *g = (struct generator *)at(loop->generators);
    for (unsigned a = 0; a < loop->axis_count; a++, g++) {
        axis_s s = state_of(law_of(loop), a);
        if (holds_output && g->volts != (mode == MODE_RAW)) {
            g->kind = GENERATOR_HOLD;
            g->parameters[0] = mode == MODE_FEEDFORWARD ? s->applied_command_um
                : mode == MODE_CLOSED_LOOP            ? s->position_um
                                                      : s->drive_v;
            g->feed_um = 0;
            g->start_tick = g->held_until = loop->tick;
        }
        g->volts = mode == MODE_RAW;
    }
}

static void set_reference(loop_p loop, const struct message *command) {
    struct generator *g = (struct generator *)at(loop->generators);
    for (unsigned a = 0; a < loop->axis_count; a++) {
        if (command->axis >= 0 && command->axis != a) continue;
        g[a].kind = (int64_t)command->values[0];
        g[a].start_tick = g[a].held_until = loop->tick;
        g[a].feed_um = 0;
        g[a].volts = loop_of(law_of(loop))->mode == MODE_RAW;
        memcpy(g[a].parameters, command->values + 1, sizeof g[a].parameters);
    }
}

static void apply_command(loop_p loop, const struct message *command) {
    law_p law = law_of(loop);
    int64_t kind = command->kind;
    const double *values = command->values;
    double refusal[2] = {(double)kind, values[0]};
    int64_t count = sizeof command->values / sizeof *values;
    if (kind == KIND_STOP) {
        store(words_of(loop) + WORD_STOP, 1);
        return;
    }
    if (kind == KIND_LOAD_LAW) abort();
    if (kind == KIND_SET_MODE && (loop_of(law)->trip || loop->stopping)) {
        kind = KIND_REFUSED;
        values = refusal;
        count = 2;
    } else if (kind == KIND_SET_MODE) {
        int64_t mode = (int64_t)values[0];
        if (mode != MODE_OFF) change_units(loop, mode, values[2] != 0);
        set_mode(law, mode, loop->tick == 0);
    } else if (kind == KIND_SET_REFERENCE) {
        set_reference(loop, command);
    } else if (kind == KIND_RESET_TRIP) {
        reset_trip(law);
    }
    publish_event(loop, kind, command->axis, command->origin, command->identity, values, count);
}

static void apply_schedule(loop_p loop) {
    const struct message *schedule = (const struct message *)at(loop->schedule);
    while (loop->scheduled < loop->schedule_count && schedule[loop->scheduled].tick <= loop->tick)
        apply_command(loop, &schedule[loop->scheduled++]);
}

static void apply_queue(loop_p loop) {
    word_p words = words_of(loop), marks = (word_p)at(loop->commands_marks);
    uint64_t tail = words[WORD_COMMANDS_TAIL], head = load(words + WORD_COMMANDS_HEAD);
    for (int taken = 0; taken < COMMANDS_PER_TICK && tail != head; taken++) {
        uint64_t slot = tail % loop->command_count, waiting = tail + 1;
        if (atomic_compare_exchange_strong(&marks[slot], &waiting, 0))
            apply_command(loop, (const struct message *)at(loop->commands) + slot);
        store(words + WORD_COMMANDS_TAIL, ++tail);
    }
}

static inline void apply_commands(loop_p loop) {
    word_p words = words_of(loop);
    if (loop->scheduled < loop->schedule_count) apply_schedule(loop);
    if (load(words + WORD_COMMANDS_HEAD) != atomic_load_explicit(words + WORD_COMMANDS_TAIL, memory_order_relaxed))
        apply_queue(loop);
}

/* What rtloop does in a tick, in C and in one piece: run_law for the law alone, run_loop for the closed loop with the
 * rig, unpaced. Left out, in favour of C: commands, snapshots, events, drivers and clocks behind pointers. */
#include <stdatomic.h>
#include <string.h>
#include "law.h"
#include "rig.h"

enum { HOLD, TABLE, STOP = 1, HEARTBEAT_NS = 2, RECORDER_CURSOR = 3, MAX_AXES = 8, COMMON = 13, PER_AXIS = 8 };

void run_law(
    const struct law_coefficients *restrict c, struct law_state *restrict s, struct loop_state *restrict loop,
    int64_t axes, const double *restrict adc_v, const double *restrict references, const int64_t *restrict modes,
    int64_t ticks, double *restrict out
) {
    const struct conditions now = {0};
    const double feeds_um[MAX_AXES] = {0};
    for (int64_t k = 0; k < ticks; k++) {
        if (modes[k] >= 0) {
            loop->trip = 0;
            loop->mode = modes[k];
            for (int64_t a = 0; a < axes; a++) s[a].entering = 1, s[a].failed = 0;
        }
        evaluate(c, s, loop, axes, &adc_v[k * axes], &references[k * axes], feeds_um, &now);
        update(c, s, loop, axes);
        out[4 * k] = s->command_um;
        out[4 * k + 1] = s->demand_v;
        out[4 * k + 2] = s->drive_v;
        out[4 * k + 3] = (double)loop->tick_flags;
    }
}

struct run {
    const struct law_coefficients *law_coefficients;
    struct law_state *law_state;
    struct loop_state *loop_state;
    const struct rig_coefficients *rig_coefficients;
    struct rig_state *rig_state;
    struct generator *generators;
    const double *table;
    _Atomic uint64_t *words, *head, *marks;
    double *slots, *last_drive_v;
    int64_t axes, columns, capacity, tick;
    double period_ns, period_us, heartbeat_timeout_ns;
};

static inline double reference_sample(struct generator *g, int64_t tick, const double *table) {
    if (tick < g->held_until) return g->held;
    if (g->kind == HOLD) {
        g->held_until = INT64_MAX;
        return g->held = g->parameters[0];
    }
    int64_t hold_ticks = (int64_t)g->parameters[2], index = (tick - g->start_tick) / hold_ticks;
    int64_t count = (int64_t)g->parameters[1];
    g->held_until = g->start_tick + (index + 1) * hold_ticks;
    index = g->parameters[3] != 0 ? index % count : index < count ? index : count - 1;
    index += (int64_t)g->parameters[0];
    g->feed_um = g->parameters[4] != 0 ? table[index + count] : 0;
    return g->held = table[index];
}

static inline void run_tick(struct run *restrict r) {
    double adc_v[MAX_AXES], references[MAX_AXES], feeds_um[MAX_AXES];
    double deadline_ns = (double)(int64_t)(r->tick * r->period_ns), none = NAN;
    for (int64_t a = 0; a < r->axes; a++) {
        adc_v[a] = rig_sample(&r->rig_coefficients[a], &r->rig_state[a]);
        references[a] = reference_sample(&r->generators[a], r->tick, r->table);
        feeds_um[a] = r->generators[a].feed_um;
    }
    double true_um[MAX_AXES], hysteresis_um[MAX_AXES];
    for (int64_t a = 0; a < r->axes; a++) {
        true_um[a] = r->rig_state[a].true_position_um;
        hysteresis_um[a] = r->rig_state[a].hysteresis_um;
    }
    double heartbeat_ns = (double)atomic_load_explicit(&r->words[HEARTBEAT_NS], memory_order_acquire);
    bool lost = none - heartbeat_ns > r->heartbeat_timeout_ns;
    struct law_state *s = r->law_state;
    struct conditions now = {.heartbeat_lost = lost, .lateness_us = (none - deadline_ns) * 1e-3};
    evaluate(r->law_coefficients, s, r->loop_state, r->axes, adc_v, references, feeds_um, &now);
    for (int64_t a = 0; a < r->axes; a++) {
        r->last_drive_v[a] = s[a].drive_v;
        rig_advance(&r->rig_coefficients[a], &r->rig_state[a], s[a].drive_v);
    }
    update(r->law_coefficients, s, r->loop_state, r->axes);

    uint64_t slot = (uint64_t)r->tick & (uint64_t)(r->capacity - 1);
    atomic_store_explicit(&r->marks[slot], UINT64_MAX, memory_order_release);
    atomic_thread_fence(memory_order_release);
    double *restrict row = r->slots + slot * (uint64_t)r->columns;
    row[0] = (double)r->tick;
    row[1] = deadline_ns;
    row[2] = (none - deadline_ns) * 1e-3;
    row[3] = row[4] = row[5] = row[6] = (none - none) * 1e-3;
    row[7] = 0;
    row[8] = (double)(r->loop_state->tick_flags | (row[2] + row[6] > r->period_us));
    row[9] = (double)r->loop_state->mode;
    row[10] = row[11] = row[12] = 0;
    double *restrict column = row + COMMON, *restrict observed = column + PER_AXIS * r->axes;
    for (int64_t a = 0; a < r->axes; a++, column += PER_AXIS, observed += 2) {
        column[0] = adc_v[a];
        column[1] = s[a].position_um;
        column[2] = references[a];
        column[3] = s[a].error_um;
        column[4] = s[a].command_um;
        column[5] = s[a].demand_v;
        column[6] = s[a].drive_v;
        column[7] = feeds_um[a];
        observed[0] = true_um[a];
        observed[1] = hysteresis_um[a];
    }
    atomic_store_explicit(&r->marks[slot], (uint64_t)r->tick + 1, memory_order_release);
    atomic_store_explicit(r->head, (uint64_t)r->tick + 1, memory_order_release);
}

void run_loop(struct run *restrict r, int64_t until_tick) {
    while (r->tick < until_tick) {
        if (atomic_load_explicit(&r->words[STOP], memory_order_acquire)) return;
        run_tick(r);
        r->tick++;
    }
}

/* Makes the core's variables arbitrary within the invariants that the proof starts from; for Frama-C's Eva only. */
#ifndef ANY_STATE_H
#define ANY_STATE_H

#include <__fc_builtin.h>
#include <stdbool.h>
#include <stdint.h>

/* Volatile variables would be taken for arbitrary at every read. Here nothing else writes them between two reads. */
static volatile uint8_t switches_now;
#define volatile

#include "../src/commands.c"
#include "../src/controller.c"
#include "../src/frame_codec.c"
#include "../src/interpolator.c"
#include "../src/link.c"
#include "../src/quadrature.c"
#include "../src/safety.c"
#include "../src/setpoint_gate.c"

/* A stop from the edge of the travel runs on by less than 2 * v * STOP_US / 2 = 1000 steps at 20000 steps/s. */
#define FARTHEST (TRAVEL_MAX + 2000L)
#define PLANNED_FARTHEST (FARTHEST + 128L) /* and the steps of the last ms, in 8 bits */

#define AHEAD_MOST (2 * STEP_Q16) /* a step, and what the speed limit makes of one tick */

#define ANY(variable) Frama_C_make_unknown((char *)&(variable), sizeof(variable))
#define ANY_BOOL() ((bool)Frama_C_interval(0, 1))

uint8_t port_read_switches(void) { return switches_now; }
void port_start_transmitter(void) {}

/* Motion: positions within FARTHEST, speeds, queue and counters anything that their types hold. */
static void any_motion(void) {
    ANY(motion.queue);
    motion.head = (uint8_t)Frama_C_interval(0, QUEUE_SLOTS - 1);
    motion.tail = (uint8_t)Frama_C_interval(0, QUEUE_SLOTS - 1);
    motion.mode = (uint8_t)Frama_C_interval(MOTION_HOLD, MOTION_RAMP);
    motion.ran_dry = ANY_BOOL();
    ANY(motion.tick);
    ANY(motion.planned_tick);
    ANY(motion.segment_ticks);
    ANY(motion.ticks_left);
    motion.ramp_tick = (uint8_t)Frama_C_interval(0, TICKS_PER_MS - 1);
    ANY(motion.direction_bits);
    for (int i = 0; i < AXIS_COUNT; i++) {
        axis_motion_t *axis = &motion.axis[i];
        ANY(*axis);
        axis->position = Frama_C_long_interval(-FARTHEST, FARTHEST);
        axis->direction = (int8_t)Frama_C_interval(-1, 1);
    }
}

/* The gate: limits as gate_configure() accepts them (proved below), counters and last set-point anything. */
static void any_gate(void) {
    for (int i = 0; i < AXIS_COUNT; i++) {
        axis_limits_t *axis = &gate.axis[i];
        axis->configured = ANY_BOOL();
        ANY(axis->speed_q16);
        ANY(axis->mean_q16);
        proposal.end[i] = gate.planned[i] = Frama_C_long_interval(-PLANNED_FARTHEST, PLANNED_FARTHEST);
        proposal.ahead_q16[i] = (uint32_t)Frama_C_unsigned_long_interval(0, AHEAD_MOST);
        axis->soft_min = Frama_C_long_interval(-TRAVEL_MAX, TRAVEL_MAX);
        axis->soft_max = Frama_C_long_interval(-TRAVEL_MAX, TRAVEL_MAX);
        gate.planned[i] = Frama_C_long_interval(-PLANNED_FARTHEST, PLANNED_FARTHEST);
        proposal.speed_q15[i] = gate.speed_q15[i] = (int16_t)Frama_C_interval(-32767, 32767);
        gate.ahead_q16[i] = (uint32_t)Frama_C_unsigned_long_interval(0, AHEAD_MOST);
    }
    ANY(gate.counted_tick);
    ANY(gate.last_number);
    gate.have_number = ANY_BOOL();
    ANY(gate.last_reject);
    ANY(gate.rejected);
    ANY(gate.expired);
    ANY(gate.overflows);
    ANY(gate.late);
}

static void any_safety(void) {
    safety.state = (uint8_t)Frama_C_interval(STATE_DISARMED, STATE_FAULT);
    safety.fault = (uint8_t)Frama_C_interval(FAULT_NONE, FAULT_BROWNOUT);
    safety.enabled = ANY_BOOL();
    safety.wiring.shared_limits = ANY_BOOL();
    safety.wiring.keep_enabled = ANY_BOOL();
    ANY(safety.inputs);
    ANY(safety.raw_inputs);
    ANY(safety.fed_tick);
    ANY(safety.deadman_age_ms);
    ANY(safety.underruns);
}

static void any_link(void) {
    ANY(serial);
    ANY(parser.body);
    parser.length = (uint8_t)Frama_C_interval(0, FRAME_MAX_RX_BODY_BYTES + 1);
    ANY(parser.block_left);
    parser.started = ANY_BOOL();
    parser.zero_due = ANY_BOOL();
    ANY(parser.crc);
    ANY(outgoing_sequence);
    for (int i = 0; i < STREAMS; i++) {
        sequence[i].known = ANY_BOOL();
        ANY(sequence[i].last);
    }
    identified = ANY_BOOL();
    ANY(answers);
    ANY(answers_head);
    ANY(answers_tail);
    ANY(boot);
}

static void any_state(void) {
    any_motion();
    any_gate();
    any_safety();
    any_link();
    ANY(quadrature);
    ANY(board_clock.ms_us);
    board_clock.slot = (uint8_t)Frama_C_interval(0, TICKS_PER_MS - 1);
}

#endif

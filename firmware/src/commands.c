/* What the board does with each frame from the host, and what it tells of itself. */
#include "commands.h"

#include "clock.h"
#include "frames.h"
#include "interpolator.h"
#include "link.h"
#include "port.h"
#include "quadrature.h"
#include "safety.h"
#include "setpoint_gate.h"

boot_t boot;
static bool identified; /* the host speaks this protocol */

/* Answers wait here while a frame out is being made: a set-point behind the command must not. */
#define ANSWERS 8 /* power of two */
typedef struct {
    uint8_t command, sequence, result;
} answer_t;
static answer_t answers[ANSWERS];
static uint8_t answers_head, answers_tail;

void commands_start(const boot_t *facts) {
    boot = *facts;
    identified = false;
    answers_head = answers_tail = 0;
}

/* Of more answers than there is room for the oldest is lost; the host asks again. */
static void answer(uint8_t command, uint8_t sequence, uint8_t result) {
    uint8_t slot = answers_head++ % ANSWERS;
    answers[slot] = (answer_t){command, sequence, result};
    if ((uint8_t)(answers_head - answers_tail) > ANSWERS) answers_tail++;
}

bool command_fits(uint8_t id, uint8_t payload_bytes) {
    switch (id) {
        case FRAME_HELLO: return payload_bytes == FRAME_HELLO_BYTES;
        case FRAME_CONFIGURE: return payload_bytes == FRAME_CONFIGURE_BYTES;
        case FRAME_ARM: return payload_bytes == FRAME_ARM_BYTES;
        case FRAME_DISARM: return payload_bytes == FRAME_DISARM_BYTES;
        case FRAME_CLEAR_FAULT: return payload_bytes == FRAME_CLEAR_FAULT_BYTES;
        case FRAME_SETPOINT: return payload_bytes == FRAME_SETPOINT_BYTES;
        case FRAME_SET_POSITION: return payload_bytes == FRAME_SET_POSITION_BYTES;
        case FRAME_PING: return payload_bytes == FRAME_PING_BYTES;
        default: return false;
    }
}

static void send_identity(void) {
    frame_identity_t *identity = (frame_identity_t *)link_payload();
    identity->protocol_hash = PROTOCOL_HASH;
    identity->firmware_version = FIRMWARE_VERSION;
    identity->boot_count = boot.boot_count;
    identity->reset_cause = boot.reset_cause;
    identity->mcu = boot.mcu;
    identity->timer_hz = TIMER_HZ;
    identity->axes = AXIS_COUNT;
    identity->queue_capacity = QUEUE_CAPACITY;
    identity->deadman_us = DEADMAN_US;
    identity->horizon_us = HORIZON_US;
    link_send(FRAME_IDENTITY, FRAME_IDENTITY_BYTES);
}

static void hello(uint8_t sequence, const frame_hello_t *frame) {
    identified = frame->protocol_hash == PROTOCOL_HASH;
    link_restart_sequence(sequence);
    answer(FRAME_HELLO, sequence, RESULT_OK);
}

static uint8_t arm(const frame_arm_t *frame) {
    if (frame->boot_count != boot.boot_count) return RESULT_BOOT_MISMATCH;
    if (!gate_configured()) return RESULT_NOT_CONFIGURED;
    uint8_t result = safety_arm();
    if (result == RESULT_OK) { /* another writer may send the set-points from now on: a homing, then the control loop */
        gate_rearm();
        link_restart_setpoints();
    }
    return result;
}

static uint8_t set_position(const frame_set_position_t *frame) {
    if (safety.state != STATE_DISARMED) return RESULT_BAD_STATE;
    int32_t steps = frame->position_steps;
    if (frame->axis >= AXIS_COUNT || steps < -TRAVEL_MAX || steps > TRAVEL_MAX) return RESULT_BAD_VALUE;
    port_lock_t lock = port_lock();
    gate_rename_position(frame->axis, steps);
    quadrature_set(frame->axis, steps);
    port_unlock(lock);
    return RESULT_OK;
}

static uint8_t execute(uint8_t id, const uint8_t *payload) {
    if (id == FRAME_PING) return RESULT_OK;
    if (id == FRAME_DISARM) return safety_disarm();
    if (!identified) return RESULT_NOT_IDENTIFIED;
    switch (id) {
        case FRAME_CONFIGURE:
            if (safety.state != STATE_DISARMED) return RESULT_BAD_STATE;
            return gate_configure((const frame_configure_t *)payload);
        case FRAME_ARM: return arm((const frame_arm_t *)payload);
        case FRAME_CLEAR_FAULT: return safety_clear(((const frame_clear_fault_t *)payload)->fault);
        default: return set_position((const frame_set_position_t *)payload);
    }
}

void command_take(uint8_t id, uint8_t sequence, const uint8_t *payload) {
    if (id == FRAME_HELLO) {
        hello(sequence, (const frame_hello_t *)payload);
        return;
    }
    if (id == FRAME_SETPOINT) {
        if (identified) gate_take((const frame_setpoint_t *)payload);
        return;
    }
    answer(id, sequence, execute(id, payload));
}

bool send_answer(void) {
    if (answers_head == answers_tail) return false;
    answer_t next = answers[answers_tail++ % ANSWERS];
    if (next.command == FRAME_HELLO) {
        send_identity();
        return true;
    }
    frame_ack_t *ack = (frame_ack_t *)link_payload();
    ack->command = next.command;
    ack->command_sequence = next.sequence;
    ack->result = next.result;
    ack->mcu_time_us = clock_now_us();
    link_send(FRAME_ACK, FRAME_ACK_BYTES);
    return true;
}

/* In short critical sections, with constant indices: the step timer must not wait, or encoders lose counts. */
static void read_motion(frame_status_t *status) {
    port_lock_t lock = port_lock();
    uint32_t ms_us = board_clock.ms_us;
    uint8_t slot = board_clock.slot;
    status->position_steps[0] = motion_position(0);
    status->position_steps[1] = motion_position(1);
    status->position_steps[2] = motion_position(2);
    port_unlock(lock);
    status->mcu_time_us = ms_us + (uint16_t)(slot * TICK_US);
    lock = port_lock();
    status->encoder_counts[0] = quadrature_count(0);
    status->encoder_counts[1] = quadrature_count(1);
    status->encoder_counts[2] = quadrature_count(2);
    port_unlock(lock);
}

static void read_safety(frame_status_t *status) {
    port_lock_t lock = port_lock();
    status->state = safety.state;
    status->fault = safety.fault;
    status->inputs = safety.inputs;
    status->queue_depth = motion_waiting();
    status->deadman_age_ms = safety.deadman_age_ms;
    status->underruns = safety.underruns;
    status->rx_overruns = serial.rx_overruns;
    status->encoder_errors = quadrature.errors;
    port_unlock(lock);
}

void send_status(void) {
    frame_status_t *status = (frame_status_t *)link_payload();
    read_motion(status);
    read_safety(status);
    status->last_setpoint = gate.last_number;
    status->last_reject = gate.last_reject;
    status->boot_count = boot.boot_count;
    status->crc_errors = serial.crc_errors;
    status->sequence_errors = serial.sequence_errors;
    status->rejected = gate.rejected;
    status->expired = gate.expired;
    status->overflows = gate.overflows;
    status->late = gate.late;
    link_send(FRAME_STATUS, FRAME_STATUS_BYTES);
}

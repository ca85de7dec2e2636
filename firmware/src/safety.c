/* Safety state machine: deadman, emergency stop, limit switches; faults latch until the operator names them. */
#include "safety.h"

#include "interpolator.h"
#include "port.h"

#define DEADMAN_TICKS ((uint16_t)(DEADMAN_US / TICK_US))
#define LIMIT_MASK 0x3FU
#define ESTOP_MASK (1U << INPUT_BIT_ESTOP)

safety_t safety;

/* The drives are powered and set-points are accepted: the dead man runs. */
static inline bool armed(void) { return safety.state == STATE_ARMED || safety.state == STATE_RUNNING; }

void safety_start(uint8_t fault, const wiring_t *wiring) {
    safety = (safety_t){0};
    safety.fault = fault;
    safety.state = fault == FAULT_NONE ? STATE_DISARMED : STATE_FAULT;
    safety.wiring = *wiring;
}

void safety_trip(uint8_t fault) {
    if (safety.fault == FAULT_NONE) safety.fault = fault;
    if (safety.state == STATE_DISARMED) safety.state = STATE_FAULT;
    if (safety.state == STATE_FAULT) return;
    safety.state = STATE_STOPPING;
    motion_stop();
}

void safety_feed(void) {
    safety.fed_tick = motion.tick;
    safety.deadman_age_ms = 0;
    safety.state = STATE_RUNNING;
}

uint8_t safety_arm(void) {
    uint8_t result = RESULT_BAD_STATE;
    port_lock_t lock = port_lock();
    if (safety.state == STATE_DISARMED) {
        safety.state = STATE_ARMED;
        safety.enabled = true;
        safety.fed_tick = motion.tick;
        safety.deadman_age_ms = 0;
        result = RESULT_OK;
    }
    port_unlock(lock);
    return result;
}

uint8_t safety_disarm(void) {
    uint8_t result = RESULT_BAD_STATE;
    port_lock_t lock = port_lock();
    if (armed()) {
        safety.state = STATE_STOPPING;
        motion_stop();
    }
    if (safety.state == STATE_DISARMED) safety.enabled = false; /* kept on a fault that was cleared since */
    if (safety.state != STATE_FAULT) result = RESULT_OK;
    port_unlock(lock);
    return result;
}

uint8_t safety_clear(uint8_t fault) {
    uint8_t result = RESULT_OK;
    port_lock_t lock = port_lock();
    if (safety.state != STATE_FAULT) {
        result = RESULT_BAD_STATE;
    } else if (fault != safety.fault) {
        result = RESULT_WRONG_FAULT;
    } else if (safety.inputs & ESTOP_MASK) {
        result = RESULT_CAUSE_PRESENT;
    } else {
        safety.fault = FAULT_NONE;
        safety.state = STATE_DISARMED;
    }
    port_unlock(lock);
    return result;
}

/* With one switch an axis both bits arrive set: keeps the one of the end the axis was moving to. */
static uint8_t tell_ends(uint8_t opened) {
    uint8_t told = opened;
    for (uint8_t axis = 0; axis < AXIS_COUNT; axis++) {
        uint8_t low = (uint8_t)(1U << (2 * axis)), high = (uint8_t)(low << 1);
        if (motion.axis[axis].direction > 0) told &= (uint8_t)~low;
        if (motion.axis[axis].direction < 0) told &= (uint8_t)~high;
    }
    return told;
}

/* A switch counts as changed when two samples 1 ms apart agree. */
void safety_watch_switches(uint8_t raw) {
    uint8_t settled = (uint8_t)~(raw ^ safety.raw_inputs);
    safety.raw_inputs = raw;
    uint8_t opened = raw & settled & (uint8_t)~safety.inputs;
    if (safety.wiring.shared_limits) {
        /* An end already told by its twin stays as it is. */
        uint8_t twins = (uint8_t)((safety.inputs & 0x15U) << 1 | (safety.inputs & 0x2AU) >> 1);
        opened &= (uint8_t)~twins;
        opened = (uint8_t)(tell_ends(opened & LIMIT_MASK) | (opened & ESTOP_MASK));
    }
    uint8_t closed = (uint8_t)~raw & settled;
    safety.inputs = (uint8_t)((safety.inputs | opened) & (uint8_t)~closed);
    if (safety.inputs & ESTOP_MASK) {
        safety_trip(FAULT_ESTOP);
    } else if ((opened & LIMIT_MASK) && safety.state != STATE_DISARMED) {
        safety_trip(FAULT_LIMIT);
    }
}

void safety_watch_setpoints(void) {
    if (motion.ran_dry) {
        motion.ran_dry = false;
        if (safety.state == STATE_RUNNING) safety.underruns++;
    }
    if (!armed()) return;
    if ((uint16_t)(motion.tick - safety.fed_tick) >= DEADMAN_TICKS) safety_trip(FAULT_DEADMAN);
}

void safety_settle(void) {
    if (armed() && safety.deadman_age_ms < 255) safety.deadman_age_ms++;
    if (safety.state != STATE_STOPPING || motion.mode != MOTION_HOLD) return;
    bool fault = safety.fault != FAULT_NONE;
    safety.state = fault ? STATE_FAULT : STATE_DISARMED;
    safety.enabled = fault && safety.wiring.keep_enabled;
}

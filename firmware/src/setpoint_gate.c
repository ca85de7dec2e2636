/* Which set-points may move the axes: order, time, speed, travel. */
#include "setpoint_gate.h"

#include "clock.h"
#include "interpolator.h"
#include "port.h"
#include "safety.h"

#define LATE_TICKS TICKS_PER_MS          /* a late set-point gets one control period */
#define LEAST_TICKS (TICKS_PER_MS / 2)   /* the step and tick grids make speeds over less meaningless */
#define MOST_TICKS 255                   /* of one segment, in 8 bits; the horizon is shorter */
#define MOST_COUNTED 4000                /* steps and ticks of one account: a ramp is shorter */
#define STEP_Q16 0x10000UL
#define STOP_MS (STOP_US / 1000)

gate_t gate;

/* What the plan looks like at one instant. */
typedef struct {
    uint32_t time_us;
    uint16_t tick, end_tick; /* now, and where the plan ends */
    uint8_t ticks;           /* from there to the new set-point: LEAST_TICKS to MOST_TICKS */
    bool at_rest;            /* no set-point in execution or waiting: the plan ends now */
    uint8_t waiting, state, inputs;
    int32_t end[AXIS_COUNT];       /* of the new segment: position, */
    int16_t speed_q15[AXIS_COUNT]; /* speed */
    uint32_t ahead_q16[AXIS_COUNT]; /* and account of the speed */
} plan_t;

static plan_t proposal; /* not on the stack: its address is known to the compiler */

void gate_start(void) { gate = (gate_t){0}; }

bool gate_configured(void) {
    for (uint8_t axis = 0; axis < AXIS_COUNT; axis++)
        if (!gate.axis[axis].configured) return false;
    return true;
}

uint8_t gate_configure(const frame_configure_t *limits) {
    uint32_t speed = limits->max_speed_steps_per_s, accel = limits->max_accel_steps_per_s2;
    int32_t soft_min = limits->soft_min_steps, soft_max = limits->soft_max_steps;
    if (limits->axis >= AXIS_COUNT || speed < 1 || speed >= TIMER_HZ) return RESULT_BAD_VALUE;
    if (soft_min < -TRAVEL_MAX || soft_max > TRAVEL_MAX || soft_min > soft_max) return RESULT_BAD_VALUE;
    /* Must be able to stop within STOP_US; 2 % of slack for limits that were rounded to whole steps. */
    if (accel > 40000000UL || accel * 51 / 1000 * STOP_MS < speed * 50) return RESULT_BAD_VALUE;
    uint32_t speed_q16 = (speed << 16) / TIMER_HZ;
    uint32_t ramp_q16 = accel / 125 * 256 / 625 + 1; /* steps/s^2 to steps per tick and ms: 65536 / 20000 / 1000 */
    uint32_t enough_q16 = speed_q16 / STOP_MS + 1;
    if (ramp_q16 < enough_q16) ramp_q16 = enough_q16;
    if (ramp_q16 > 0xFFFF) ramp_q16 = 0xFFFF;
    axis_limits_t *axis = &gate.axis[limits->axis];
    axis->speed_q16 = (uint16_t)speed_q16;
    /* Of many set-points: 1/64 more. A board's resonator is off by up to 0.5 %, and speed_q16 was rounded down. */
    uint32_t mean_q16 = speed_q16 + (speed_q16 >> 6) + 1;
    axis->mean_q16 = mean_q16 > 0xFFFF ? 0xFFFF : (uint16_t)mean_q16;
    axis->soft_min = soft_min;
    axis->soft_max = soft_max;
    axis->configured = true;
    motion_set_limits(limits->axis, (uint16_t)speed_q16, (uint16_t)ramp_q16);
    return RESULT_OK;
}

void gate_rearm(void) { gate.have_number = false; }

void gate_rename_position(uint8_t axis, int32_t steps) {
    motion_rename_position(axis, steps);
    gate.planned[axis] = steps;
}

static inline uint16_t at_most(uint32_t value, uint16_t most) { return value < most ? (uint16_t)value : most; }

/* The account of an axis after so many steps in so many ticks, each at most MOST_COUNTED. */
static inline uint32_t account(uint32_t ahead_q16, uint16_t mean_q16, uint16_t steps, uint16_t ticks) {
    uint32_t allowed_q16 = (uint32_t)mean_q16 * ticks;
    uint32_t used_q16 = ahead_q16 + ((uint32_t)steps << 16);
    return used_q16 > allowed_q16 ? used_q16 - allowed_q16 : 0;
}

/* At rest the plan starts from where the axes are: a ramp may have moved them since the last account. */
static void plan_from(const plan_t *rest) {
    uint16_t ticks = at_most((uint16_t)(rest->tick - gate.counted_tick), MOST_COUNTED);
    gate.counted_tick = rest->tick;
    for (uint8_t i = 0; i < AXIS_COUNT; i++) {
        int32_t moved = rest->end[i] - gate.planned[i];
        uint16_t steps = at_most((uint32_t)(moved < 0 ? -moved : moved), MOST_COUNTED);
        uint32_t ahead_q16 = account(gate.ahead_q16[i], gate.axis[i].mean_q16, steps, ticks);
        gate.ahead_q16[i] = ahead_q16 < STEP_Q16 ? ahead_q16 : STEP_Q16;
        gate.planned[i] = rest->end[i];
    }
}

static void snapshot(plan_t *plan) {
    port_lock_t lock = port_lock();
    plan->time_us = clock_locked_us();
    plan->tick = motion.tick;
    plan->waiting = motion_waiting();
    plan->state = safety.state;
    plan->inputs = safety.inputs;
    plan->end_tick = motion.planned_tick;
    plan->at_rest = motion.mode != MOTION_SEGMENT && !plan->waiting;
    if (plan->at_rest) {
        plan->end_tick = motion.tick;
        for (uint8_t axis = 0; axis < AXIS_COUNT; axis++) {
            plan->end[axis] = motion_position(axis);
            gate.speed_q15[axis] = motion_ramp_speed_q15(axis);
        }
    }
    port_unlock(lock);
    if (plan->at_rest) plan_from(plan);
}

/* us / TICK_US without a division, exact up to HORIZON_US. */
static inline uint16_t to_ticks(uint16_t us) { return (uint16_t)((uint32_t)us * 5243U >> 18); }

/* Chooses the tick at which the set-point is reached; returns why it cannot be. */
static uint8_t check_time(const frame_setpoint_t *setpoint, plan_t *plan) {
    int32_t ahead_us = (int32_t)(setpoint->execute_us - plan->time_us);
    if (ahead_us > (int32_t)HORIZON_US) return REJECT_HORIZON;
    if (ahead_us + (int32_t)setpoint->expiry_us < 0) return REJECT_EXPIRED;
    if (ahead_us > 0) {
        uint16_t ticks = (uint16_t)(plan->tick + to_ticks((uint16_t)ahead_us) - plan->end_tick);
        if (ticks >= LEAST_TICKS && ticks <= MOST_TICKS) {
            plan->ticks = (uint8_t)ticks;
            return REJECT_NONE;
        }
        if (!plan->at_rest) return REJECT_ORDER;
    }
    gate.late++;
    return REJECT_NONE;
}

/* Whether a switch stands open at the end of the travel that the axis would move towards. */
static bool towards_open_switch(int32_t delta, uint8_t inputs, uint8_t index) {
    uint8_t low = (uint8_t)(1U << (2 * index));
    return (delta < 0 && (inputs & low)) || (delta > 0 && (inputs & (low << 1)));
}

/* The speed from which a ramp may have to start. It follows the set-points no faster than the axis accelerates (and a
 * quarter more): a single jump in position is no speed, and must not be run out like one. */
static uint16_t follow_speed(uint8_t index, int32_t delta, uint16_t rate_q16, uint8_t ticks, int16_t *followed_q15) {
    uint16_t change = (uint16_t)(((uint32_t)motion.axis[index].ramp_q16 * ticks) >> 5); /* q15; 1.25 / 2 / 20 */
    int32_t wanted = delta < 0 ? -(int32_t)(rate_q16 >> 1) : (int32_t)(rate_q16 >> 1);
    int32_t speed = gate.speed_q15[index];
    if (wanted > speed + change)
        speed += change;
    else if (wanted < speed - change)
        speed -= change;
    else
        speed = wanted;
    *followed_q15 = (int16_t)speed;
    if ((speed < 0) != (delta < 0)) return 0;
    return (uint16_t)(speed < 0 ? -2 * speed : 2 * speed);
}

/* The step grid and the tick grid each allow for one count more than the limit; the account of the speed keeps short
 * segments from adding these up. */
static uint8_t check_axes(const frame_setpoint_t *setpoint, plan_t *plan, segment_t *segment) {
    uint8_t ticks = plan->ticks;
    uint16_t per_step_q16 = ticks == TICKS_PER_MS ? 0xFFFFU / TICKS_PER_MS : (uint16_t)(0xFFFFU / ticks);
    for (uint8_t i = 0; i < AXIS_COUNT; i++) {
        int32_t wanted = setpoint->position_steps[i];
        if (wanted < gate.axis[i].soft_min || wanted > gate.axis[i].soft_max) return REJECT_SOFT_LIMIT;
        int32_t delta = wanted - gate.planned[i]; /* both within the travel, so within 32 bits */
        if (towards_open_switch(delta, plan->inputs, i)) return REJECT_LIMIT_SWITCH;
        uint32_t distance = (uint32_t)(delta < 0 ? -delta : delta);
        if (distance > ticks) return REJECT_SPEED; /* an axis makes at most one step a tick */
        uint32_t ahead_q16 = account(gate.ahead_q16[i], gate.axis[i].mean_q16, (uint16_t)distance, ticks);
        if (ahead_q16 > STEP_Q16 + gate.axis[i].speed_q16) return REJECT_SPEED;
        plan->ahead_q16[i] = ahead_q16;
        uint16_t rate_q16 = distance >= ticks ? 0xFFFF : (uint16_t)((uint16_t)distance * per_step_q16);
        segment->rate_q16[i] = follow_speed(i, delta, rate_q16, ticks, &plan->speed_q15[i]);
        segment->target[i] = (uint16_t)wanted;
        plan->end[i] = wanted;
    }
    return REJECT_NONE;
}

/* The interrupt may have stopped the axes since the snapshot. */
static uint8_t commit(void) {
    uint8_t reject = REJECT_STATE;
    port_lock_t lock = port_lock();
    if (safety.state == STATE_ARMED || safety.state == STATE_RUNNING) {
        motion_append();
        safety_feed();
        reject = REJECT_NONE;
    }
    port_unlock(lock);
    return reject;
}

static void remember(uint16_t number, const plan_t *plan) {
    gate.last_number = number;
    gate.have_number = true;
    for (uint8_t i = 0; i < AXIS_COUNT; i++) {
        gate.planned[i] = plan->end[i];
        gate.speed_q15[i] = plan->speed_q15[i];
        gate.ahead_q16[i] = plan->ahead_q16[i];
    }
    gate.counted_tick = (uint16_t)(plan->end_tick + plan->ticks);
}

static uint8_t judge(const frame_setpoint_t *setpoint) {
    proposal.ticks = LATE_TICKS;
    segment_t *segment = motion_free_slot();
    snapshot(&proposal);
    if (proposal.state != STATE_ARMED && proposal.state != STATE_RUNNING) return REJECT_STATE;
    if (gate.have_number && (int16_t)(setpoint->number - gate.last_number) <= 0) return REJECT_ORDER;
    if (proposal.waiting >= QUEUE_CAPACITY) return REJECT_OVERFLOW;
    uint8_t reject = check_time(setpoint, &proposal);
    segment->end_tick = (uint16_t)(proposal.end_tick + proposal.ticks);
    if (!reject) reject = check_axes(setpoint, &proposal, segment);
    if (!reject) reject = commit();
    if (!reject) remember(setpoint->number, &proposal);
    return reject;
}

void gate_take(const frame_setpoint_t *setpoint) {
    uint8_t reject = judge(setpoint);
    if (!reject) return;
    gate.last_reject = reject;
    if (reject == REJECT_EXPIRED)
        gate.expired++;
    else if (reject == REJECT_OVERFLOW)
        gate.overflows++;
    else
        gate.rejected++;
}

/* Safety as tables: which set-points are refused, what each command answers in each state, what trips and what clears. */
#include "bench.h"

static const int32_t ORIGIN[AXIS_COUNT] = {0};

static uint8_t reject_of(uint16_t number, int32_t ahead_us, uint16_t expiry_us, int32_t p0, int32_t p1, int32_t p2) {
    gate.last_reject = REJECT_NONE;
    send_setpoint(number, ahead_us, expiry_us, (const int32_t[]){p0, p1, p2});
    return gate.last_reject;
}

static void refused_setpoints(void) {
    bring_up();
    CHECK_EQUAL(reject_of(10, 1000, 0, 0, 0, 0), REJECT_NONE);
    CHECK_EQUAL(reject_of(10, 2000, 0, 0, 0, 0), REJECT_ORDER); /* the same number again */
    CHECK_EQUAL(reject_of(9, 2000, 0, 0, 0, 0), REJECT_ORDER);
    CHECK_EQUAL(reject_of(11, 900, 0, 0, 0, 0), REJECT_ORDER); /* before the last one's time */
    CHECK_EQUAL(reject_of(12, (int32_t)HORIZON_US + 50, 0, 0, 0, 0), REJECT_HORIZON);
    CHECK_EQUAL(reject_of(13, -1000, 900, 0, 0, 0), REJECT_EXPIRED);
    CHECK_EQUAL(reject_of(14, 2000, 0, 19, 0, 0), REJECT_SPEED); /* 16.25 steps/ms, one tick and one step of slack */
    CHECK_EQUAL(reject_of(15, 2000, 0, 0, 0, -15), REJECT_SPEED);
    CHECK_EQUAL(reject_of(16, 2000, 0, INT32_MAX, 0, 0), REJECT_SOFT_LIMIT);
    CHECK_EQUAL(reject_of(17, 2000, 0, 0, INT32_MIN, 0), REJECT_SOFT_LIMIT);
    CHECK_EQUAL(reject_of(18, 2000, 0, 17, 0, 0), REJECT_NONE);
    CHECK_EQUAL(reject_of(19, 3000, 0, 17, 0, 0), REJECT_NONE);
    CHECK_EQUAL(reject_of(20, 4000, 0, 17, 0, 0), REJECT_NONE);
    CHECK_EQUAL(motion_waiting(), QUEUE_CAPACITY);
    CHECK_EQUAL(reject_of(30, 7000, 0, 17, 0, 0), REJECT_OVERFLOW);
    CHECK_EQUAL(gate.expired, 1);
    CHECK_EQUAL(gate.overflows, 1);
    CHECK_EQUAL(gate.rejected, 8);
    run_ms(10);
    CHECK_EQUAL(bench.steps[0], 17);
}

static void late_but_not_expired(void) {
    bring_up();
    CHECK_EQUAL(reject_of(1, -1000, 2000, 5, 0, 0), REJECT_NONE);
    CHECK_EQUAL(gate.late, 1);
    run_ms(4);
    CHECK_EQUAL(bench.steps[0], 5);
}

static void wrapping_clock(void) {
    bring_up();
    board_clock.ms_us = 0xFFFFFFFFUL - 1500;
    int32_t position[AXIS_COUNT] = {0};
    cruise_ms(20, position, (const int32_t[]){7, -7, 3});
    cruise_ms(5, position, (const int32_t[]){0, 0, 0});
    CHECK_EQUAL(gate.rejected + gate.expired + gate.late, 0);
    CHECK_EQUAL(bench.steps[1], -140);
}

static void configuration(void) {
    power_up(RESET_CAUSE_POWER, false);
    frame_configure_t good = LIMITS[1], bad;
    CHECK_EQUAL(command(FRAME_CONFIGURE, &good, sizeof good), RESULT_NOT_IDENTIFIED);
    frame_hello_t stranger = {PROTOCOL_HASH ^ 1};
    command(FRAME_HELLO, &stranger, sizeof stranger);
    CHECK_EQUAL(command(FRAME_CONFIGURE, &good, sizeof good), RESULT_NOT_IDENTIFIED);
    hello();
    CHECK_EQUAL(arm(), RESULT_NOT_CONFIGURED);
    bad = good, bad.axis = 3;
    CHECK_EQUAL(command(FRAME_CONFIGURE, &bad, sizeof bad), RESULT_BAD_VALUE);
    bad = good, bad.max_speed_steps_per_s = TIMER_HZ;
    CHECK_EQUAL(command(FRAME_CONFIGURE, &bad, sizeof bad), RESULT_BAD_VALUE);
    bad = good, bad.max_accel_steps_per_s2 = 200000; /* 61 ms from full speed */
    CHECK_EQUAL(command(FRAME_CONFIGURE, &bad, sizeof bad), RESULT_BAD_VALUE);
    bad = good, bad.soft_min_steps = 2000000;
    CHECK_EQUAL(command(FRAME_CONFIGURE, &bad, sizeof bad), RESULT_BAD_VALUE);
    configure_all();
    frame_arm_t other_boot = {8};
    CHECK_EQUAL(command(FRAME_ARM, &other_boot, sizeof other_boot), RESULT_BOOT_MISMATCH);
    CHECK_EQUAL(reject_of(1, 1000, 0, 0, 0, 0), REJECT_STATE);
    CHECK_EQUAL(arm(), RESULT_OK);
    CHECK_EQUAL(command(FRAME_CONFIGURE, &good, sizeof good), RESULT_BAD_STATE);
    frame_set_position_t move = {0, 5};
    CHECK_EQUAL(command(FRAME_SET_POSITION, &move, sizeof move), RESULT_BAD_STATE);
}

static void deadman_latches(void) {
    bring_up();
    send_setpoint(1, 1000, 0, ORIGIN);
    run_ms(29);
    CHECK_EQUAL(safety.state, STATE_RUNNING);
    run_ms(2);
    CHECK_EQUAL(safety.fault, FAULT_DEADMAN);
    run_ms(10);
    CHECK_EQUAL(safety.state, STATE_FAULT);
    CHECK_EQUAL(reject_of(2, 1000, 0, 0, 0, 0), REJECT_STATE);
    CHECK_EQUAL(arm(), RESULT_BAD_STATE);
    CHECK_EQUAL(command(FRAME_DISARM, NULL, 0), RESULT_BAD_STATE);
    hello();
    CHECK_EQUAL(safety.state, STATE_FAULT);
    CHECK_EQUAL(clear_fault(FAULT_ESTOP), RESULT_WRONG_FAULT);
    CHECK_EQUAL(clear_fault(FAULT_DEADMAN), RESULT_OK);
    CHECK_EQUAL(safety.state, STATE_DISARMED);
    CHECK_EQUAL(arm(), RESULT_OK);
}

/* A host that arms and then sends nothing: the dead man runs from ARM on. */
static void deadman_runs_from_arming(void) {
    bring_up();
    run_ms(29);
    CHECK_EQUAL(safety.state, STATE_ARMED);
    CHECK(safety.deadman_age_ms >= 28);
    run_ms(2);
    CHECK_EQUAL(safety.fault, FAULT_DEADMAN);
    run_ms(2);
    CHECK_EQUAL(safety.state, STATE_FAULT);
    CHECK(!bench.enabled);
}

/* Positions beyond the travel are no names for a place: differences to them leave 32 bits. */
static void positions_beyond_the_travel(void) {
    static const int32_t BAD[] = {INT32_MAX, INT32_MIN, 1000000001, -1000000001};
    power_up(RESET_CAUSE_POWER, false);
    hello();
    configure_all();
    for (unsigned i = 0; i < sizeof BAD / sizeof BAD[0]; i++) {
        frame_set_position_t frame = {0, BAD[i]};
        CHECK_EQUAL(command(FRAME_SET_POSITION, &frame, sizeof frame), RESULT_BAD_VALUE);
        CHECK_EQUAL(motion_position(0), 0);
    }
    frame_set_position_t edge = {0, -1000000000};
    CHECK_EQUAL(command(FRAME_SET_POSITION, &edge, sizeof edge), RESULT_OK);
    frame_configure_t far = LIMITS[0];
    far.soft_min_steps = -1000000000, far.soft_max_steps = 1000000000;
    CHECK_EQUAL(command(FRAME_CONFIGURE, &far, sizeof far), RESULT_OK);
    CHECK_EQUAL(arm(), RESULT_OK);
    CHECK_EQUAL(reject_of(1, 1000, 0, 1000000000, 0, 0), REJECT_SPEED);
    CHECK_EQUAL(reject_of(2, 1000, 0, -999999990, 0, 0), REJECT_NONE);
    run_ms(3);
    CHECK_EQUAL(motion_position(0), -999999990);
}

/* An axis makes at most one step a tick: what asks for more is refused, or its steps would be owed for ever. */
static void no_more_than_one_step_a_tick(void) {
    power_up(RESET_CAUSE_POWER, false);
    hello();
    configure_all();
    frame_configure_t fast = LIMITS[0];
    fast.max_speed_steps_per_s = TIMER_HZ - 1, fast.max_accel_steps_per_s2 = 2000000;
    CHECK_EQUAL(command(FRAME_CONFIGURE, &fast, sizeof fast), RESULT_OK);
    CHECK_EQUAL(arm(), RESULT_OK);
    CHECK_EQUAL(reject_of(1, 1000, 0, 21, 0, 0), REJECT_SPEED);
    CHECK_EQUAL(reject_of(2, 1000, 0, 20, 0, 0), REJECT_NONE);
    CHECK_EQUAL(reject_of(3, 2000, 0, 41, 0, 0), REJECT_SPEED);
    CHECK_EQUAL(reject_of(4, 2000, 0, 40, 0, 0), REJECT_NONE);
    CHECK_EQUAL(reject_of(5, 3000, 0, 40, 0, 0), REJECT_NONE);
    run_ms(5);
    CHECK_EQUAL(motion_position(0), 40);
}

/* The drives are powered from ARM until the axes rest; on a fault too where the wiring says so, then until DISARM. */
static void enable_line(bool keep) {
    power_up_wired(RESET_CAUSE_POWER, (wiring_t){.keep_enabled = keep});
    run_ms(2);
    CHECK(!bench.enabled);
    hello();
    configure_all();
    CHECK_EQUAL(arm(), RESULT_OK);
    int32_t position[AXIS_COUNT] = {0};
    cruise_ms(20, position, (const int32_t[]){10, 0, 0});
    CHECK(bench.enabled);
    bench.switches = 1U << INPUT_BIT_ESTOP;
    run_ms(5);
    CHECK_EQUAL(safety.state, STATE_STOPPING);
    CHECK(bench.enabled); /* it decelerates under power */
    run_ms(60);
    CHECK_EQUAL(safety.state, STATE_FAULT);
    CHECK_EQUAL(bench.enabled, keep);
    bench.switches = 0;
    run_ms(5);
    CHECK_EQUAL(clear_fault(FAULT_ESTOP), RESULT_OK);
    run_ms(5);
    CHECK_EQUAL(bench.enabled, keep);
    CHECK_EQUAL(command(FRAME_DISARM, NULL, 0), RESULT_OK);
    run_ms(2);
    CHECK(!bench.enabled);
    CHECK_EQUAL(arm(), RESULT_OK);
    run_ms(1);
    CHECK(bench.enabled);
    command(FRAME_DISARM, NULL, 0);
    run_ms(3);
    CHECK(!bench.enabled);
    bench.switches = 1U << INPUT_BIT_ESTOP; /* of a board that is not armed */
    run_ms(5);
    CHECK_EQUAL(safety.state, STATE_FAULT);
    CHECK(!bench.enabled);
    power_up_wired(RESET_CAUSE_WATCHDOG, (wiring_t){.keep_enabled = keep});
    run_ms(2);
    CHECK_EQUAL(safety.state, STATE_FAULT);
    CHECK(!bench.enabled);
}

static void the_first_fault_stays(void) {
    bring_up();
    send_setpoint(1, 1000, 0, ORIGIN);
    run_ms(40);
    bench.switches = 1U << INPUT_BIT_ESTOP;
    run_ms(5);
    CHECK_EQUAL(safety.fault, FAULT_DEADMAN);
    CHECK_EQUAL(clear_fault(FAULT_DEADMAN), RESULT_CAUSE_PRESENT);
}

/* A host with another protocol greets a running board: its set-points are not understood, so not taken. */
static void stranger_in_the_session(void) {
    bring_up();
    send_setpoint(1, 1000, 0, ORIGIN);
    frame_hello_t stranger = {PROTOCOL_HASH ^ 1};
    command(FRAME_HELLO, &stranger, sizeof stranger);
    for (uint16_t i = 0; i < 40; i++) {
        send_setpoint((uint16_t)(2 + i), 1000, 0, (const int32_t[]){1, 0, 0});
        run_ms(1);
    }
    CHECK_EQUAL(safety.fault, FAULT_DEADMAN);
    CHECK_EQUAL(bench.steps[0], 0);
}

/* Refused set-points do not feed the deadman. */
static void deadman_wants_valid_setpoints(void) {
    bring_up();
    send_setpoint(1, 1000, 0, ORIGIN);
    for (uint16_t i = 0; i < 40; i++) {
        send_setpoint((uint16_t)(2 + i), 1000, 0, (const int32_t[]){500, 0, 0});
        run_ms(1);
    }
    CHECK_EQUAL(safety.fault, FAULT_DEADMAN);
}

static void emergency_stop(void) {
    static const uint8_t PREPARE[] = {STATE_DISARMED, STATE_ARMED, STATE_RUNNING};
    for (unsigned i = 0; i < sizeof PREPARE; i++) {
        bring_up();
        int32_t position[AXIS_COUNT] = {0};
        if (PREPARE[i] == STATE_DISARMED) command(FRAME_DISARM, NULL, 0), run_ms(2);
        if (PREPARE[i] == STATE_RUNNING) cruise_ms(20, position, (const int32_t[]){16, 12, -12});
        CHECK_EQUAL(safety.state, PREPARE[i]);
        uint32_t pressed_us = clock_now_us();
        bench.switches = 1U << INPUT_BIT_ESTOP;
        run_ms(3);
        CHECK_EQUAL(safety.fault, FAULT_ESTOP);
        run_ms(60);
        CHECK_EQUAL(safety.state, STATE_FAULT);
        CHECK(bench.last_edge_us <= pressed_us + 2000 + STOP_US);
        CHECK_EQUAL(clear_fault(FAULT_ESTOP), RESULT_CAUSE_PRESENT);
        bench.switches = 0;
        run_ms(3);
        CHECK_EQUAL(safety.state, STATE_FAULT);
        CHECK_EQUAL(clear_fault(FAULT_ESTOP), RESULT_OK);
    }
}

static void glitch_is_not_a_switch(void) {
    bring_up();
    for (unsigned i = 0; i < 200; i++) {
        bench.switches = i % 3 ? 0 : 0x7F; /* single samples */
        send_setpoint((uint16_t)(i + 1), 1000, 0, ORIGIN);
        run_ms(1);
    }
    CHECK_EQUAL(safety.fault, FAULT_NONE);
}

static void limit_switch(bool shared) {
    power_up(RESET_CAUSE_POWER, shared);
    hello();
    configure_all();
    arm();
    int32_t position[AXIS_COUNT] = {0};
    cruise_ms(20, position, (const int32_t[]){0, -5, 0});
    bench.switches = shared ? 3U << INPUT_BIT_LIMIT_1_MIN : 1U << INPUT_BIT_LIMIT_1_MIN;
    cruise_ms(5, position, (const int32_t[]){0, 0, 0});
    CHECK_EQUAL(safety.fault, FAULT_LIMIT);
    CHECK_EQUAL(safety.inputs, 1U << INPUT_BIT_LIMIT_1_MIN);
    run_ms(60);
    CHECK_EQUAL(clear_fault(FAULT_LIMIT), RESULT_OK);
    CHECK_EQUAL(arm(), RESULT_OK);
    int32_t here = motion_position(1);
    CHECK_EQUAL(reject_of(100, 2000, 0, 0, here - 5, 0), REJECT_LIMIT_SWITCH);
    CHECK_EQUAL(reject_of(101, 2000, 0, 0, here + 5, 0), REJECT_NONE);
    CHECK_EQUAL(reject_of(102, 3000, 0, 0, here + 5, 0), REJECT_NONE);
    run_ms(5);
    CHECK_EQUAL(motion_position(1), here + 5);
    CHECK_EQUAL(safety.inputs, 1U << INPUT_BIT_LIMIT_1_MIN);
    bench.switches = 0;
    run_ms(5);
    CHECK_EQUAL(safety.inputs, 0);
    CHECK_EQUAL(reject_of(103, 2000, 0, 0, here + 1, 0), REJECT_NONE);
}

static void restarts(void) {
    power_up(RESET_CAUSE_WATCHDOG, false);
    CHECK_EQUAL(safety.state, STATE_FAULT);
    hello();
    CHECK_EQUAL(clear_fault(FAULT_WATCHDOG), RESULT_OK);
    power_up(RESET_CAUSE_BROWNOUT, false);
    CHECK_EQUAL(safety.fault, FAULT_BROWNOUT);
    power_up(RESET_CAUSE_EXTERNAL, false);
    CHECK_EQUAL(safety.state, STATE_DISARMED);
}

static void sequence_numbers(void) {
    bring_up();
    uint8_t frame[FRAME_MAX_WIRE_BYTES];
    unsigned n = make_frame(frame, FRAME_PING, ++bench.command_sequence, NULL, 0);
    uint32_t before = bench.frames_out;
    receive(frame, n);
    receive(frame, n);
    while (controller_poll()) {}
    read_out();
    CHECK_EQUAL(bench.frames_out - before, 1);
    CHECK_EQUAL(serial.sequence_errors, 1);
    bench.command_sequence += 3;
    command(FRAME_PING, NULL, 0);
    CHECK_EQUAL(serial.sequence_errors, 4);
}

int main(void) {
    refused_setpoints();
    late_but_not_expired();
    wrapping_clock();
    configuration();
    deadman_latches();
    deadman_runs_from_arming();
    positions_beyond_the_travel();
    no_more_than_one_step_a_tick();
    enable_line(false);
    enable_line(true);
    the_first_fault_stays();
    stranger_in_the_session();
    deadman_wants_valid_setpoints();
    emergency_stop();
    glitch_is_not_a_switch();
    limit_switch(false);
    limit_switch(true);
    restarts();
    sequence_numbers();
    puts("safety: ok");
    return 0;
}

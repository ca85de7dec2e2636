/* Interpolation and stopping: every step commanded is made, on time, and every stop is a ramp. */
#include "bench.h"

static void random_moves(void) {
    bring_up();
    int32_t position[AXIS_COUNT] = {0};
    for (unsigned move = 0; move < 2000; move++) {
        int32_t speed[AXIS_COUNT];
        for (unsigned axis = 0; axis < AXIS_COUNT; axis++) speed[axis] = (int32_t)(random_u32() % 25) - 12;
        cruise_ms(1 + random_u32() % 4, position, speed);
    }
    cruise_ms(10, position, (const int32_t[]){0, 0, 0});
    for (unsigned axis = 0; axis < AXIS_COUNT; axis++) {
        CHECK_EQUAL(bench.steps[axis], position[axis]);
        CHECK_EQUAL(motion_position((uint8_t)axis), position[axis]);
    }
    CHECK_EQUAL(bench.status.rejected + bench.status.underruns + bench.status.crc_errors + bench.status.late, 0);
    CHECK_EQUAL(safety.state, STATE_RUNNING);
}

/* The position of a set-point is reached at its time, to one tick. */
static void on_time(void) {
    bring_up();
    const int32_t target[AXIS_COUNT] = {40, -30, 1};
    send_setpoint(1, 5000, 1000, target);
    uint32_t due = clock_now_us() + 5000;
    while (clock_now_us() < due - 2500) tick();
    CHECK(bench.steps[0] >= 19 && bench.steps[0] <= 21);
    while (clock_now_us() < due - 200) tick();
    CHECK(bench.steps[0] < 40);
    while (clock_now_us() < due) tick();
    for (unsigned axis = 0; axis < AXIS_COUNT; axis++) CHECK_EQUAL(bench.steps[axis], target[axis]);
}

/* Silence at full speed: at rest 50 ms after the deadman at the latest, within the distance of a uniform
 * deceleration, and no two steps closer than the ones before. */
static void deadman_ramp(void) {
    for (unsigned axis = 0; axis < AXIS_COUNT; axis++) {
        bring_up();
        int32_t position[AXIS_COUNT] = {0}, speed[AXIS_COUNT] = {0};
        speed[axis] = (int32_t)(LIMITS[axis].max_speed_steps_per_s / 1000);
        cruise_ms(60, position, speed); /* the board believes in the speed after v/a */
        uint32_t last_setpoint_us = clock_now_us() - 1000;
        run_ms(120);
        CHECK_EQUAL(safety.state, STATE_FAULT);
        CHECK_EQUAL(safety.fault, FAULT_DEADMAN);
        CHECK(bench.last_edge_us - last_setpoint_us <= DEADMAN_US + STOP_US);
        int64_t overrun = bench.steps[axis] - position[axis];
        int64_t v = speed[axis] * 1000, a = LIMITS[axis].max_accel_steps_per_s2;
        CHECK(overrun >= 0 && overrun <= v * v / (2 * a) + 1);
        CHECK(overrun >= v * v / (2 * a) * 8 / 10);
        CHECK_EQUAL(bench.steps[axis], motion_position((uint8_t)axis));
    }
}

static void ramp_never_speeds_up(void) {
    bring_up();
    int32_t position[AXIS_COUNT] = {0};
    cruise_ms(30, position, (const int32_t[]){16, 0, 0});
    command(FRAME_DISARM, NULL, 0);
    uint32_t last = 0, gap = 0;
    int64_t before = bench.steps[0];
    for (unsigned i = 0; i < 60 * TICKS_PER_MS; i++) {
        tick();
        if (bench.steps[0] == before) continue;
        before = bench.steps[0];
        if (last && gap) CHECK(bench.last_edge_us - last + 2 * TICK_US > gap);
        if (last) gap = bench.last_edge_us - last;
        last = bench.last_edge_us;
    }
    CHECK_EQUAL(safety.state, STATE_DISARMED);
    CHECK(gap > 1000);
}

/* A host that pauses below the deadman and comes back: counted, and every step accounted for. The axes have run on
 * by the ramp's length meanwhile, so at high speed its old path may be out of reach, and is refused. */
static void underrun_and_back(void) {
    bring_up();
    int32_t position[AXIS_COUNT] = {0};
    cruise_ms(20, position, (const int32_t[]){6, 3, -3});
    run_ms(12);
    CHECK(bench.steps[0] > position[0]);
    cruise_ms(1, position, (const int32_t[]){0, 0, 0});
    run_ms(2);
    cruise_ms(10, position, (const int32_t[]){0, 0, 0});
    CHECK(safety.underruns >= 1);
    CHECK_EQUAL(safety.state, STATE_RUNNING);
    for (unsigned axis = 0; axis < AXIS_COUNT; axis++) {
        CHECK_EQUAL(bench.steps[axis], position[axis]);
        CHECK_EQUAL(motion_position((uint8_t)axis), position[axis]);
    }
}

/* Positions that jump to and fro, late, with pauses: no speed, so nothing runs on. */
static void jumps_do_not_run_on(void) {
    bring_up();
    for (unsigned i = 0; i < 2000; i++) {
        const int32_t target[AXIS_COUNT] = {i & 1 ? 6 : 0, i & 2 ? 4 : 0, 0};
        send_setpoint(++bench.number, (int32_t)(random_u32() % 1200) - 300, 2000, target);
        unsigned ticks = 10 + random_u32() % 30;
        while (ticks--) {
            tick();
            CHECK(bench.steps[0] >= -2 && bench.steps[0] <= 8);
            CHECK(bench.steps[1] >= -2 && bench.steps[1] <= 6);
        }
    }
    CHECK(bench.status.last_setpoint > 1500);
}

/* Right after a reversal the board does not run on in the new direction with the old speed. */
static void reversal_does_not_run_on(void) {
    bring_up();
    int32_t position[AXIS_COUNT] = {0};
    cruise_ms(60, position, (const int32_t[]){12, 0, 0});
    cruise_ms(1, position, (const int32_t[]){-6, 0, 0});
    run_ms(60);
    CHECK(bench.steps[0] >= position[0] - 2);
}

/* Limits rounded a little past what stops in time: the stop takes its time all the same. */
static void stops_in_time_at_the_edge(void) {
    power_up(RESET_CAUSE_POWER, false);
    hello();
    configure_all();
    frame_configure_t edge = LIMITS[1];
    edge.max_accel_steps_per_s2 = 240000; /* 50.9 ms from full speed */
    CHECK_EQUAL(command(FRAME_CONFIGURE, &edge, sizeof edge), RESULT_OK);
    arm();
    int32_t position[AXIS_COUNT] = {0};
    for (unsigned i = 0; i < 20; i++) { /* 12.2 steps/ms */
        cruise_ms(4, position, (const int32_t[]){0, 12, 0});
        cruise_ms(1, position, (const int32_t[]){0, 13, 0});
    }
    while (motion_waiting()) tick(); /* until the fastest of them is executed */
    uint32_t now_us = clock_now_us();
    command(FRAME_DISARM, NULL, 0);
    while (motion.mode != MOTION_HOLD) tick();
    CHECK(clock_now_us() - now_us <= STOP_US);
}

static void encoders(void) {
    static const uint8_t AB[4] = {0, 1, 3, 2};
    bring_up();
    int32_t count[AXIS_COUNT] = {0};
    for (unsigned i = 0; i < 20000; i++) {
        uint8_t bits = 0;
        for (unsigned axis = 0; axis < AXIS_COUNT; axis++) {
            count[axis] += (int32_t)(random_u32() % 3) - 1;
            bits |= (uint8_t)(AB[(uint32_t)count[axis] & 3U] << (2 * axis));
        }
        bench.encoder_bits = bits;
        tick();
    }
    for (unsigned axis = 0; axis < AXIS_COUNT; axis++) CHECK_EQUAL(quadrature_count((uint8_t)axis), count[axis]);
    CHECK_EQUAL(quadrature.errors, 0);
    bench.encoder_bits ^= 3;
    tick();
    CHECK_EQUAL(quadrature.errors, 1);
}

int main(void) {
    random_moves();
    on_time();
    deadman_ramp();
    ramp_never_speeds_up();
    underrun_and_back();
    jumps_do_not_run_on();
    reversal_does_not_run_on();
    stops_in_time_at_the_edge();
    encoders();
    puts("motion: ok");
    return 0;
}

/* Speed and travel at every boundary: the farthest set-point that the gate accepts, and the next one, which it refuses. */
#include "bench.h"

/* Configures axis 0 with this speed and travel, and arms; position 0 or, where that is outside, the nearest end. */
static void prepare(uint32_t speed, int32_t soft_min, int32_t soft_max) {
    power_up(RESET_CAUSE_POWER, false);
    hello();
    configure_all();
    frame_configure_t limits = {0, speed, speed * 40 < 1000 ? 1000 : speed * 40, soft_min, soft_max};
    CHECK_EQUAL(command(FRAME_CONFIGURE, &limits, sizeof limits), RESULT_OK);
    frame_set_position_t here = {0, soft_min > 0 ? soft_min : soft_max < 0 ? soft_max : 0};
    CHECK_EQUAL(command(FRAME_SET_POSITION, &here, sizeof here), RESULT_OK);
    CHECK_EQUAL(arm(), RESULT_OK);
}

static unsigned long offered;

/* Offers one set-point so many ticks ahead; what was queued is taken out again. */
static uint8_t offer(unsigned ticks, int32_t position) {
    frame_setpoint_t setpoint = {.number = ++bench.number, .execute_us = clock_now_us() + ticks * TICK_US};
    setpoint.position_steps[0] = position;
    gate.last_reject = REJECT_NONE;
    offered++;
    memset(gate.ahead_q16, 0, sizeof gate.ahead_q16);
    gate.planned[0] = motion_position(0);
    gate_take(&setpoint);
    motion.head = motion.tail;
    return gate.last_reject;
}

/* Steps that `speed`, and 1/64 more, makes in the ticks, one tick and one step more, and never more than one a tick. */
static int32_t farthest(uint32_t speed, unsigned ticks) {
    uint64_t speed_q16 = (speed << 16) / TIMER_HZ, mean_q16 = speed_q16 + speed_q16 / 64 + 1;
    uint64_t allowed_q16 = (mean_q16 > 0xFFFF ? 0xFFFF : mean_q16) * ticks;
    int32_t steps = (int32_t)((allowed_q16 + speed_q16) >> 16) + 1;
    return steps < (int32_t)ticks ? steps : (int32_t)ticks;
}

static void check_speed(uint32_t speed, unsigned ticks) {
    int32_t most = farthest(speed, ticks);
    /* The bound in steps/s: the limit, 2 % and a step in 65536 ticks. */
    CHECK((most - 1) * 50.0 * TIMER_HZ <= speed * 51.0 * (ticks + 1) + 50.0 * ticks * TIMER_HZ / 65000);
    CHECK_EQUAL(offer(ticks, most), REJECT_NONE);
    CHECK_EQUAL(offer(ticks, most + 1), REJECT_SPEED);
    CHECK_EQUAL(offer(ticks, -most - 1), REJECT_SPEED);
    CHECK_EQUAL(offer(ticks, -most), REJECT_NONE);
}

static void every_speed(void) {
    static const unsigned TICKS[] = {10, 11, 20, 127, 128, 240};
    for (uint32_t speed = 1; speed < TIMER_HZ; speed++) {
        if (speed % 2000 == 1) prepare(speed, -1000, 1000);
        frame_configure_t limits = {0, speed, speed * 40 < 1000 ? 1000 : speed * 40, -1000, 1000};
        CHECK_EQUAL(gate_configure(&limits), RESULT_OK);
        for (unsigned i = 0; i < sizeof TICKS / sizeof TICKS[0]; i++) check_speed(speed, TICKS[i]);
    }
}

static void every_length(void) {
    static const uint32_t SPEEDS[] = {1, 999, 1000, 1001, 12223, 16000, 19999};
    for (unsigned i = 0; i < sizeof SPEEDS / sizeof SPEEDS[0]; i++) {
        prepare(SPEEDS[i], -1000, 1000);
        for (unsigned ticks = 10; ticks <= HORIZON_US / TICK_US; ticks++) check_speed(SPEEDS[i], ticks);
        CHECK_EQUAL(offer(HORIZON_US / TICK_US + 1, 0), REJECT_HORIZON);
    }
}

static void every_end_of_the_travel(void) {
    static const int32_t ENDS[] = {-TRAVEL_MAX, -TRAVEL_MAX + 1, -65536, -32769, -32768, -1, 0, 1,
                                   32767, 32768, 65535, 65536, TRAVEL_MAX - 1, TRAVEL_MAX};
    static const int32_t BEYOND[] = {INT32_MIN, INT32_MIN + 1, -TRAVEL_MAX - 1, TRAVEL_MAX + 1, INT32_MAX - 1, INT32_MAX};
    const unsigned n = sizeof ENDS / sizeof ENDS[0];
    for (unsigned low = 0; low < n; low++) {
        for (unsigned high = low; high < n; high++) {
            prepare(16000, ENDS[low], ENDS[high]);
            for (unsigned i = 0; i < sizeof BEYOND / sizeof BEYOND[0]; i++)
                CHECK_EQUAL(offer(20, BEYOND[i]), REJECT_SOFT_LIMIT);
            for (int side = 0; side < 2; side++) {
                int32_t end = ENDS[side ? high : low], past = end + (side ? 1 : -1);
                gate_rename_position(0, end);
                CHECK_EQUAL(offer(20, past), REJECT_SOFT_LIMIT);
                CHECK_EQUAL(offer(20, end), REJECT_NONE);
                gate_rename_position(0, past); /* outside, as after a stop that ran on: only back in */
                CHECK_EQUAL(offer(20, past), REJECT_SOFT_LIMIT);
                CHECK_EQUAL(offer(20, end), REJECT_NONE);
            }
        }
    }
}

/* Limits that are refused, at each bound of each field. */
static void every_bound_of_configure(void) {
    static const struct { frame_configure_t limits; uint8_t result; } ROWS[] = {
        {{0, 1, 1000, -TRAVEL_MAX, TRAVEL_MAX}, RESULT_OK},
        {{0, 0, 1000, 0, 1}, RESULT_BAD_VALUE},
        {{0, TIMER_HZ - 1, 40000000, 0, 0}, RESULT_OK},
        {{0, TIMER_HZ, 40000000, 0, 0}, RESULT_BAD_VALUE},
        {{0, UINT32_MAX, UINT32_MAX, 0, 0}, RESULT_BAD_VALUE},
        {{0, 1000, 40000001, 0, 0}, RESULT_BAD_VALUE},
        {{0, 1000, 0, 0, 0}, RESULT_BAD_VALUE},
        {{AXIS_COUNT, 1000, 40000, 0, 0}, RESULT_BAD_VALUE},
        {{255, 1000, 40000, 0, 0}, RESULT_BAD_VALUE},
        {{0, 1000, 40000, -TRAVEL_MAX - 1, 0}, RESULT_BAD_VALUE},
        {{0, 1000, 40000, 0, TRAVEL_MAX + 1}, RESULT_BAD_VALUE},
        {{0, 1000, 40000, INT32_MIN, INT32_MAX}, RESULT_BAD_VALUE},
        {{0, 1000, 40000, 1, 0}, RESULT_BAD_VALUE},
        {{0, 1000, 40000, INT32_MAX, INT32_MIN}, RESULT_BAD_VALUE},
    };
    for (unsigned i = 0; i < sizeof ROWS / sizeof ROWS[0]; i++) {
        power_up(RESET_CAUSE_POWER, false);
        hello();
        CHECK_EQUAL(command(FRAME_CONFIGURE, &ROWS[i].limits, sizeof ROWS[i].limits), ROWS[i].result);
    }
}

/* Set-points as close as they may come, each with the one step that its grid allows for: the mean speed holds. */
static void slack_does_not_add_up(void) {
    static const uint32_t SPEEDS[] = {20, 100, 1000, 5000, 16000};
    for (unsigned i = 0; i < sizeof SPEEDS / sizeof SPEEDS[0]; i++) {
        prepare(SPEEDS[i], -TRAVEL_MAX, TRAVEL_MAX);
        int32_t position[AXIS_COUNT] = {0};
        for (unsigned turn = 0; turn < 2000; turn++) { /* one a 0.5 ms, 1 s in all */
            uint16_t before = gate.rejected;
            position[0] += (int32_t)(SPEEDS[i] / 2000) + 1;
            send_setpoint(++bench.number, 1000, 0, position);
            if (gate.rejected != before) {
                position[0] = gate.planned[0] + (int32_t)(SPEEDS[i] / 2000);
                send_setpoint(++bench.number, 1000, 0, position);
            }
            for (unsigned t = 0; t < TICKS_PER_MS / 2; t++) tick();
        }
        CHECK_EQUAL(safety.state, STATE_RUNNING);
        CHECK((double)bench.steps[0] <= SPEEDS[i] * 1.02 + 3);
        CHECK((double)bench.steps[0] >= SPEEDS[i] * 0.8);
    }
}

int main(void) {
    slack_does_not_add_up();
    every_speed();
    every_length();
    every_end_of_the_travel();
    every_bound_of_configure();
    printf("limits: ok (%lu set-points)\n", offered);
    return 0;
}

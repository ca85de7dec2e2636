/* Valid but hostile sequences: whole frames of every kind with extreme arguments, in every state, under the sanitizers.
 *
 * fuzz_frames SEED SEQUENCES: sequence k depends on SEED + k alone, and its number is printed when one fails.
 * Where fuzz_link damages bytes, this keeps every frame whole, so that all of them reach the commands and the gate.
 */
#include <signal.h>
#include <unistd.h>

#include "bench.h"

#define ACTIONS 16
#define OVERRUN 2000 /* steps that a stop at full speed may run on beyond the travel */

static uint64_t random_state;
static unsigned long long sequence_number, ticks_done, frames_sent, accepted, steps_made, reached[STATE_FAULT + 1];
static int64_t speed_level_q16[AXIS_COUNT]; /* steps made ahead of the limit in force, as a leaky bucket */
static uint16_t ticks_since_fed;

static uint32_t next_random(void) { /* splitmix64 */
    uint64_t z = random_state += 0x9E3779B97F4A7C15U;
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9U;
    z = (z ^ z >> 27) * 0x94D049BB133111EBU;
    return (uint32_t)(z >> 32);
}

static uint32_t below(uint32_t n) { return next_random() % n; }

static int32_t extreme(void) {
    static const int32_t VALUES[] = {0, 1, -1, 127, 128, 255, 256, 32767, 32768, -32768, -32769, 65535, 65536, TRAVEL_MAX - 1,
                                     TRAVEL_MAX, TRAVEL_MAX + 1, -TRAVEL_MAX, -TRAVEL_MAX - 1, INT32_MAX - 1, INT32_MAX,
                                     INT32_MIN + 1, INT32_MIN};
    return below(4) ? VALUES[below(sizeof VALUES / sizeof VALUES[0])] : (int32_t)next_random();
}

/* What must hold at every tick, whatever was sent. */
static void one_tick(void) {
    uint8_t state = safety.state;
    int32_t before[AXIS_COUNT];
    for (uint8_t i = 0; i < AXIS_COUNT; i++) before[i] = motion_position(i);
    uint8_t out = controller_tick(bench.encoder_bits);
    for (uint8_t i = 0; i < AXIS_COUNT; i++) {
        int32_t step = motion_position(i) - before[i];
        CHECK_EQUAL(step != 0, out >> i & 1U);
        CHECK(step >= -1 && step <= 1);
        CHECK(!step || state == STATE_RUNNING || state == STATE_STOPPING);
        CHECK(motion_position(i) <= TRAVEL_MAX + OVERRUN && motion_position(i) >= -TRAVEL_MAX - OVERRUN);
        /* Away from the travel only as far as a stop runs on. */
        if (step > 0) CHECK(motion_position(i) <= gate.axis[i].soft_max + OVERRUN);
        if (step < 0) CHECK(motion_position(i) >= gate.axis[i].soft_min - OVERRUN);
        int64_t limit_q16 = (int64_t)gate.axis[i].speed_q16 + 1;
        speed_level_q16[i] += (step ? 65536 : 0) - limit_q16 - limit_q16 / 64;
        if (speed_level_q16[i] < 0) speed_level_q16[i] = 0;
        CHECK(speed_level_q16[i] <= 5 * 65536);
        steps_made += step != 0;
    }
    bool armed = safety.state == STATE_ARMED || safety.state == STATE_RUNNING;
    ticks_since_fed = armed ? (uint16_t)(ticks_since_fed + 1) : 0;
    CHECK(ticks_since_fed <= DEADMAN_US / TICK_US + TICKS_PER_MS); /* the dead man, from ARM on */
    bool powered = out & OUTPUT_ENABLE;
    if (armed || safety.state == STATE_STOPPING) CHECK(powered);
    if (!armed && safety.state != STATE_STOPPING && !safety.wiring.keep_enabled) CHECK(!powered);
    while (controller_poll()) {}
    uint8_t byte;
    while (link_next_byte(&byte)) {}
    reached[safety.state]++;
    ticks_done++;
}

static void send(uint8_t id, const void *payload, uint8_t n) {
    uint8_t frame[FRAME_MAX_WIRE_BYTES];
    uint16_t number = gate.last_number;
    bool known = gate.have_number;
    uint8_t state = safety.state;
    receive(frame, make_frame(frame, id, id == FRAME_SETPOINT ? ++bench.setpoint_sequence : ++bench.command_sequence, payload, n));
    while (controller_poll()) {}
    frames_sent++;
    bool taken = id == FRAME_SETPOINT && (gate.last_number != number || gate.have_number != known);
    accepted += taken;
    if (taken || (id == FRAME_ARM && safety.state == STATE_ARMED && state == STATE_DISARMED)) ticks_since_fed = 0;
}

static void configure(void) {
    frame_configure_t frame = {.axis = (uint8_t)below(AXIS_COUNT)};
    frame.max_speed_steps_per_s = below(3) ? 1 + below(TIMER_HZ - 1) : (uint32_t)extreme();
    frame.max_accel_steps_per_s2 = below(3) ? frame.max_speed_steps_per_s * (20 + below(200)) : (uint32_t)extreme();
    frame.soft_min_steps = below(2) ? -1000 : extreme();
    frame.soft_max_steps = below(2) ? 1000 : extreme();
    if (below(50) == 0) frame.axis = (uint8_t)next_random();
    send(FRAME_CONFIGURE, &frame, sizeof frame);
}

static void setpoint(void) {
    static const int32_t AHEAD[] = {0, 1, -1, 500, 1000, 2000, 11999, 12000, 12001, -5000, INT32_MAX, INT32_MIN};
    int32_t ahead = below(3) ? 1000 * (1 + motion_waiting()) + (int32_t)below(500) : AHEAD[below(sizeof AHEAD / sizeof AHEAD[0])];
    frame_setpoint_t frame = {.number = (uint16_t)(gate.last_number + 1), .execute_us = clock_now_us() + (uint32_t)ahead};
    frame.expiry_us = below(2) ? 5000 : (uint16_t)extreme();
    for (unsigned i = 0; i < AXIS_COUNT; i++)
        frame.position_steps[i] = below(8) ? gate.planned[i] + (int32_t)below(45) - 22 : extreme();
    if (below(20) == 0) frame.number = (uint16_t)next_random();
    send(FRAME_SETPOINT, &frame, sizeof frame);
}

static void act(void) {
    frame_hello_t greeting = {below(8) ? PROTOCOL_HASH : next_random()};
    frame_arm_t arming = {below(16) ? 7 : (uint16_t)next_random()};
    frame_clear_fault_t clearing = {below(4) ? safety.fault : (uint8_t)next_random()};
    frame_set_position_t naming = {(uint8_t)(below(16) ? below(AXIS_COUNT) : next_random()), extreme()};
    switch (below(24)) {
        case 0: send(FRAME_HELLO, &greeting, sizeof greeting); break;
        case 1: configure(); break;
        case 2: case 3: send(FRAME_ARM, &arming, sizeof arming); break;
        case 4: send(FRAME_DISARM, NULL, 0); break;
        case 5: send(FRAME_CLEAR_FAULT, &clearing, sizeof clearing); break;
        case 6: send(FRAME_SET_POSITION, &naming, sizeof naming); break;
        case 7: send(FRAME_PING, NULL, 0); break;
        case 8: bench.switches = below(2) ? 0 : (uint8_t)(next_random() & 0x7F); break;
        case 9: bench.encoder_bits = (uint8_t)(next_random() & 0x3F); break;
        default: setpoint();
    }
    unsigned ticks = below(64) ? below(16) : below(1200);
    while (ticks--) one_tick();
}

/* One sequence: a start of any kind, mostly brought up and armed, then any actions. */
static void run(uint64_t seed) {
    random_state = seed;
    memset(speed_level_q16, 0, sizeof speed_level_q16);
    ticks_since_fed = 0;
    wiring_t wiring = {.shared_limits = below(2), .keep_enabled = below(2)};
    power_up_wired((uint8_t)below(RESET_CAUSE_WATCHDOG + 1), wiring);
    if (below(8)) {
        hello();
        clear_fault(safety.fault);
        for (unsigned i = 0; i < AXIS_COUNT; i++) command(FRAME_CONFIGURE, &LIMITS[i], sizeof LIMITS[i]);
        for (unsigned i = below(3); i; i--) configure();
        if (below(4) == 0) {
            frame_set_position_t naming = {(uint8_t)below(AXIS_COUNT), extreme()};
            send(FRAME_SET_POSITION, &naming, sizeof naming);
        }
        if (below(8)) arm();
    }
    for (unsigned i = 0; i < ACTIONS; i++) act();
}

static void on_failure(int number) {
    (void)number;
    fprintf(stderr, "fuzz_frames: sequence %llu failed; repeat it with: fuzz_frames %llu 1\n", sequence_number, sequence_number);
    _exit(77);
}

static void on_exit_failure(void) {
    if (sequence_number) fprintf(stderr, "fuzz_frames: last sequence %llu\n", sequence_number);
}

int main(int argc, char **argv) {
    if (argc != 3) return fprintf(stderr, "usage: %s SEED SEQUENCES\n", argv[0]), 2;
    signal(SIGABRT, on_failure);
    atexit(on_exit_failure);
    unsigned long long first = strtoull(argv[1], NULL, 10), count = strtoull(argv[2], NULL, 10);
    for (unsigned long long k = 0; k < count; k++) {
        sequence_number = first + k;
        run(sequence_number);
    }
    sequence_number = 0;
    printf("{\"sequences\": %llu, \"frames\": %llu, \"setpoints_accepted\": %llu, \"steps\": %llu, \"ticks\": %llu, "
           "\"ticks_by_state\": [%llu, %llu, %llu, %llu, %llu], \"findings\": 0}\n",
           count, frames_sent, accepted, steps_made, ticks_done, reached[0], reached[1], reached[2], reached[3], reached[4]);
    return 0;
}

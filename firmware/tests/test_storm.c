/* Anything on the line and on the switches at once: the invariants hold, under the sanitizers. */
#include "bench.h"

static void random_command(void) {
    static const uint8_t IDS[] = {FRAME_HELLO, FRAME_CONFIGURE, FRAME_ARM, FRAME_DISARM, FRAME_CLEAR_FAULT,
                                  FRAME_SETPOINT, FRAME_SET_POSITION, FRAME_PING, 0x42, FRAME_STATUS};
    static const uint8_t BYTES[] = {FRAME_HELLO_BYTES, FRAME_CONFIGURE_BYTES, FRAME_ARM_BYTES, FRAME_DISARM_BYTES,
                                    FRAME_CLEAR_FAULT_BYTES, FRAME_SETPOINT_BYTES, FRAME_SET_POSITION_BYTES,
                                    FRAME_PING_BYTES, 3, 20};
    unsigned which = random_u32() % sizeof IDS;
    uint8_t payload[32], frame[FRAME_MAX_WIRE_BYTES];
    for (unsigned i = 0; i < sizeof payload; i++) payload[i] = (uint8_t)random_u32();
    uint8_t sequence = IDS[which] == FRAME_SETPOINT ? ++bench.setpoint_sequence : ++bench.command_sequence;
    unsigned n = make_frame(frame, IDS[which], sequence, payload, BYTES[which]);
    if (random_u32() % 4 == 0) frame[random_u32() % n] ^= (uint8_t)(1U << random_u32() % 8);
    receive(frame, n);
}

/* May be refused, or lost behind a damaged frame. */
static void try_configure(void) {
    for (unsigned axis = 0; axis < AXIS_COUNT; axis++) command(FRAME_CONFIGURE, &LIMITS[axis], sizeof LIMITS[axis]);
}

static void sensible_command(int32_t position[AXIS_COUNT]) {
    switch (random_u32() % 40) {
        case 0: hello(); break;
        case 1: arm(); break;
        case 2: clear_fault(safety.fault); break;
        case 3: command(FRAME_DISARM, NULL, 0); break;
        case 4: try_configure(); break;
        default:
            for (unsigned axis = 0; axis < AXIS_COUNT; axis++)
                position[axis] = motion_position((uint8_t)axis) + (int32_t)(random_u32() % 41) - 20;
            send_setpoint(++bench.number, (int32_t)(random_u32() % 9000) - 1000, (uint16_t)(random_u32() % 2000), position);
    }
}

int main(void) {
    bring_up();
    int32_t position[AXIS_COUNT] = {0};
    uint64_t moved = 0;
    for (unsigned i = 0; i < 300000; i++) {
        uint32_t choice = random_u32() % 16;
        if (choice == 0) random_command();
        if (choice == 1 && safety.state == STATE_DISARMED) hello(), try_configure();
        if (choice < 8 && choice > 1) sensible_command(position);
        if (random_u32() % 500 == 0) bench.switches = random_u32() % 3 ? 0 : (uint8_t)(random_u32() & 0x7F);
        uint8_t state = safety.state;
        int32_t before[AXIS_COUNT];
        for (unsigned axis = 0; axis < AXIS_COUNT; axis++) before[axis] = motion_position((uint8_t)axis);
        memset(bench.steps, 0, sizeof bench.steps);
        uint8_t out = controller_tick(bench.encoder_bits);
        for (unsigned axis = 0; axis < AXIS_COUNT; axis++) {
            int32_t step = motion_position((uint8_t)axis) - before[axis];
            CHECK_EQUAL(step != 0, out >> axis & 1U);
            CHECK(step == 0 || state == STATE_RUNNING || state == STATE_STOPPING);
            if (step) CHECK_EQUAL(step, out >> (OUTPUT_DIRECTION_SHIFT + axis) & 1U ? -1 : 1);
            moved += step != 0;
        }
        while (controller_poll()) {}
        read_out();
        CHECK(motion_waiting() <= QUEUE_CAPACITY);
    }
    CHECK(moved > 1000);
    printf("storm: ok (%llu steps)\n", (unsigned long long)moved);
    return 0;
}

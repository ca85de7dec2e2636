/* A test bench around the core: the processor's layer, a host that sends frames, and a counter of steps. */
#ifndef BENCH_H
#define BENCH_H

#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "clock.h"
#include "controller.h"
#include "frame_codec.h"
#include "frames.h"
#include "interpolator.h"
#include "link.h"
#include "port.h"
#include "quadrature.h"
#include "safety.h"
#include "setpoint_gate.h"

#define CHECK(condition)                                                             \
    do {                                                                             \
        if (!(condition)) {                                                          \
            fprintf(stderr, "%s:%d: wanted %s\n", __FILE__, __LINE__, #condition);   \
            exit(1);                                                                 \
        }                                                                            \
    } while (0)
#define CHECK_EQUAL(found, wanted)                                                                              \
    do {                                                                                                        \
        long long found_ = (long long)(found), wanted_ = (long long)(wanted);                                   \
        if (found_ != wanted_) {                                                                                \
            fprintf(stderr, "%s:%d: %s: found %lld, wanted %lld\n", __FILE__, __LINE__, #found, found_, wanted_); \
            exit(1);                                                                                            \
        }                                                                                                       \
    } while (0)

/* The fastest axis of the rig, 0.05 m/s and 2 m/s^2 at 320 steps/mm, and its rotary ones. */
static const frame_configure_t LIMITS[AXIS_COUNT] = {
    {0, 16000, 640000, -1000000, 1000000},
    {1, 12223, 244462, -1000000, 1000000},
    {2, 12223, 244462, -1000000, 1000000},
};

typedef struct {
    uint8_t switches, encoder_bits;
    uint8_t command_sequence, setpoint_sequence;
    uint16_t number;
    int64_t steps[AXIS_COUNT]; /* edges, with their sign */
    uint32_t last_edge_us;
    bool enabled;        /* the enable line as the last tick left it */
    uint8_t last_result; /* of the last ACK */
    frame_status_t status;
    uint32_t frames_out;
} bench_t;

static bench_t bench;

void port_start_transmitter(void) {}
uint8_t port_read_switches(void) { return bench.switches; }

/* The board's own parser takes no longer frames than SETPOINT, so the bench has its own. */
static inline void take_out(const uint8_t *body, uint8_t length) {
    bench.frames_out++;
    if (body[0] == FRAME_STATUS && length == FRAME_STATUS_BYTES + 4) memcpy(&bench.status, body + 2, sizeof bench.status);
    if (body[0] == FRAME_ACK) bench.last_result = body[4];
}

static inline void read_out(void) {
    static uint8_t raw[512];
    static unsigned used;
    uint8_t byte, body[512];
    while (link_next_byte(&byte)) {
        raw[used++] = byte;
        CHECK(used <= FRAME_MAX_WIRE_BYTES);
        if (byte) continue;
        unsigned at = 0, length = 0;
        while (at + 1 < used) {
            unsigned code = raw[at++];
            for (unsigned i = 1; i < code; i++) body[length++] = raw[at++];
            if (at + 1 < used) body[length++] = 0;
        }
        CHECK_EQUAL(crc16(body, (uint8_t)length), 0);
        take_out(body, (uint8_t)length);
        used = 0;
    }
}

static inline void tick(void) {
    uint8_t out = controller_tick(bench.encoder_bits);
    bench.enabled = out & OUTPUT_ENABLE;
    for (unsigned axis = 0; axis < AXIS_COUNT; axis++) {
        if (!(out >> axis & 1U)) continue;
        bench.steps[axis] += out >> (OUTPUT_DIRECTION_SHIFT + axis) & 1U ? -1 : 1;
        bench.last_edge_us = clock_now_us();
    }
    while (controller_poll()) {}
    read_out();
}

static inline void run_ms(unsigned ms) {
    for (unsigned i = 0; i < ms * TICKS_PER_MS; i++) tick();
}

static inline void receive(const uint8_t *bytes, unsigned n) {
    for (unsigned i = 0; i < n; i++) link_receive(bytes[i], false);
}

static inline unsigned make_frame(uint8_t *frame, uint8_t id, uint8_t sequence, const void *payload, uint8_t n) {
    if (n) memcpy(frame + 3, payload, n);
    frame_writer_t writer;
    frame_begin(&writer, frame, id, sequence, n);
    bool done;
    uint8_t ready = 0, before;
    do {
        before = ready;
        ready = frame_work(&writer, 5, &done);
        CHECK(ready >= before);
    } while (!done);
    return ready;
}

static inline uint8_t command(uint8_t id, const void *payload, uint8_t n) {
    uint8_t frame[FRAME_MAX_WIRE_BYTES];
    bench.last_result = 0xFF;
    receive(frame, make_frame(frame, id, ++bench.command_sequence, payload, n));
    while (controller_poll()) {}
    read_out();
    return bench.last_result;
}

static inline void send_setpoint(uint16_t number, int32_t ahead_us, uint16_t expiry_us, const int32_t position[AXIS_COUNT]) {
    frame_setpoint_t setpoint = {.number = number, .execute_us = clock_now_us() + (uint32_t)ahead_us, .expiry_us = expiry_us};
    for (unsigned axis = 0; axis < AXIS_COUNT; axis++) setpoint.position_steps[axis] = position[axis];
    uint8_t frame[FRAME_MAX_WIRE_BYTES];
    receive(frame, make_frame(frame, FRAME_SETPOINT, ++bench.setpoint_sequence, &setpoint, sizeof setpoint));
    while (controller_poll()) {}
}

static inline void power_up_wired(uint8_t reset_cause, wiring_t wiring) {
    boot_t facts = {.boot_count = 7, .reset_cause = reset_cause, .mcu = MCU_NATIVE};
    bench = (bench_t){0};
    controller_start(&facts, &wiring, 0);
    for (uint8_t byte; link_next_byte(&byte);) {}
}

static inline void power_up(uint8_t reset_cause, bool shared_limits) {
    power_up_wired(reset_cause, (wiring_t){.shared_limits = shared_limits});
}

static inline void hello(void) {
    frame_hello_t frame = {PROTOCOL_HASH};
    command(FRAME_HELLO, &frame, sizeof frame);
}

static inline void configure_all(void) {
    for (unsigned axis = 0; axis < AXIS_COUNT; axis++)
        CHECK_EQUAL(command(FRAME_CONFIGURE, &LIMITS[axis], sizeof LIMITS[axis]), RESULT_OK);
}

static inline uint8_t arm(void) {
    frame_arm_t frame = {7};
    return command(FRAME_ARM, &frame, sizeof frame);
}

static inline uint8_t clear_fault(uint8_t fault) {
    frame_clear_fault_t frame = {fault};
    return command(FRAME_CLEAR_FAULT, &frame, sizeof frame);
}

static inline void bring_up(void) {
    power_up(RESET_CAUSE_POWER, false);
    hello();
    configure_all();
    CHECK_EQUAL(arm(), RESULT_OK);
}

/* One control period at constant speed, set-points 3 ms ahead. */
static inline void cruise_ms(unsigned ms, int32_t position[AXIS_COUNT], const int32_t steps_per_ms[AXIS_COUNT]) {
    for (unsigned i = 0; i < ms; i++) {
        for (unsigned axis = 0; axis < AXIS_COUNT; axis++) position[axis] += steps_per_ms[axis];
        send_setpoint(++bench.number, 3000, 5000, position);
        run_ms(1);
    }
}

/* xorshift: the same numbers everywhere. */
static inline uint32_t random_u32(void) {
    static uint32_t x = 2463534242U;
    x ^= x << 13;
    x ^= x >> 17;
    x ^= x << 5;
    return x;
}

#endif

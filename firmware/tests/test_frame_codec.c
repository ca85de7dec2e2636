/* Framing: what was sent arrives, what was damaged does not. */
#include "bench.h"

static frame_parser_t parser;

static unsigned feed(const uint8_t *bytes, unsigned n, uint8_t *body, uint8_t *length) {
    unsigned frames = 0;
    while (n) {
        uint8_t taken = n > 255 ? 255 : (uint8_t)n;
        parse_t result = frame_parse(&parser, bytes, &taken);
        if (result == PARSE_FRAME) {
            frames++;
            memcpy(body, parser.body, parser.length);
            *length = parser.length;
        }
        bytes += taken;
        n -= taken;
    }
    return frames;
}

static void check_value_of_crc(void) { CHECK_EQUAL(crc16((const uint8_t *)"123456789", 9), 0x29B1); }

static void round_trip(void) {
    for (unsigned i = 0; i < 20000; i++) {
        uint8_t frame[FRAME_MAX_WIRE_BYTES], body[64], length = 0, payload[FRAME_SETPOINT_BYTES];
        uint8_t n = (uint8_t)(random_u32() % (FRAME_SETPOINT_BYTES + 1));
        for (unsigned k = 0; k < n; k++) payload[k] = random_u32() % 3 ? (uint8_t)random_u32() : 0;
        unsigned wire = make_frame(frame, (uint8_t)i, (uint8_t)(i >> 8), payload, n);
        CHECK_EQUAL(feed(frame, wire, body, &length), 1);
        CHECK_EQUAL(length, n + 4);
        CHECK_EQUAL(body[0], (uint8_t)i);
        CHECK(n == 0 || memcmp(body + 2, payload, n) == 0);
    }
}

/* Every single and double bit flip of a frame, delimiter included, with a whole frame after it. */
static void flipped_bits(void) {
    frame_setpoint_t setpoint = {.number = 5, .execute_us = 123456, .expiry_us = 0, .position_steps = {100, -1, 0}};
    uint8_t frame[FRAME_MAX_WIRE_BYTES], bad[FRAME_MAX_WIRE_BYTES], body[64], length;
    unsigned n = make_frame(frame, FRAME_SETPOINT, 9, &setpoint, sizeof setpoint);
    for (unsigned a = 0; a < 8 * n; a++)
        for (unsigned b = a; b < 8 * n; b++) {
            memcpy(bad, frame, n);
            bad[a / 8] ^= (uint8_t)(1U << a % 8);
            if (b != a) bad[b / 8] ^= (uint8_t)(1U << b % 8);
            CHECK_EQUAL(feed(bad, n, body, &length), 0);
            feed((const uint8_t *)"", 1, body, &length); /* ends what is left over */
            CHECK_EQUAL(feed(frame, n, body, &length), 1);
        }
}

static void cut_and_joined(void) {
    uint8_t frame[FRAME_MAX_WIRE_BYTES], joined[2 * FRAME_MAX_WIRE_BYTES], body[64], length;
    frame_arm_t payload = {300};
    unsigned n = make_frame(frame, FRAME_ARM, 1, &payload, sizeof payload);
    for (unsigned cut = 0; cut + 1 < n; cut++) {
        memcpy(joined, frame, cut);
        memcpy(joined + cut, frame, n); /* a frame cut off by the next one: at most the next survives */
        unsigned frames = feed(joined, cut + n, body, &length);
        CHECK(frames <= 1 && (frames == 0 || memcmp(body + 2, &payload, sizeof payload) == 0));
    }
}

static void noise(void) {
    uint8_t chunk[200], body[64], length;
    unsigned frames = 0;
    for (unsigned i = 0; i < 20000; i++) {
        for (unsigned k = 0; k < sizeof chunk; k++) chunk[k] = random_u32() % 8 ? (uint8_t)random_u32() : 0;
        frames += feed(chunk, sizeof chunk, body, &length);
    }
    /* 16 bits of check sum let one in 65536 pieces of noise pass; id and length stop nearly all of these later. */
    CHECK(frames < 40);
}

int main(void) {
    check_value_of_crc();
    round_trip();
    flipped_bits();
    cut_and_joined();
    noise();
    puts("frame codec: ok");
    return 0;
}

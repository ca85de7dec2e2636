/* COBS framing and CRC-16 of the serial link. */
#include "frame_codec.h"

/* Polynomial 0x1021 a byte at a time, in operations on 8 bits for the AVR. */
uint16_t crc16(const uint8_t *data, uint8_t length) {
    uint8_t high = 0xFF, low = 0xFF;
    while (length--) {
        uint8_t x = high ^ *data++;
        x ^= (uint8_t)(x >> 4);
        high = (uint8_t)(low ^ (uint8_t)(x << 4) ^ (uint8_t)(x >> 3));
        low = (uint8_t)(x ^ (uint8_t)(x << 5));
    }
    return (uint16_t)(low | (uint16_t)((uint16_t)high << 8));
}

static parse_t finish(frame_parser_t *parser) {
    if (!parser->started) return PARSE_MORE; /* delimiters may come in a row */
    parser->started = false;
    uint8_t length = parser->length;
    if (parser->block_left || length < FRAME_OVERHEAD_BYTES || length > FRAME_MAX_RX_BODY_BYTES) return PARSE_DAMAGED;
    uint8_t covered = (uint8_t)(length - 2);
    uint16_t sent = (uint16_t)(parser->body[covered] | (uint16_t)((uint16_t)parser->body[covered + 1] << 8));
    return crc16(parser->body, covered) == sent ? PARSE_FRAME : PARSE_DAMAGED;
}

static inline void append(frame_parser_t *parser, uint8_t byte) {
    if (parser->length < FRAME_MAX_RX_BODY_BYTES) parser->body[parser->length] = byte;
    if (parser->length <= FRAME_MAX_RX_BODY_BYTES) parser->length++;
}

static void start_block(frame_parser_t *parser, uint8_t code) {
    if (!parser->started) {
        parser->started = true;
        parser->length = 0;
    } else if (parser->zero_due) {
        append(parser, 0);
    }
    parser->block_left = (uint8_t)(code - 1);
    parser->zero_due = code != 0xFF;
}

parse_t frame_parse(frame_parser_t *parser, const uint8_t *bytes, uint8_t *n) {
    const uint8_t *at = bytes, *end = bytes + *n;
    parse_t result = PARSE_MORE;
    while (at != end && result == PARSE_MORE) {
        uint8_t byte = *at++;
        if (byte == 0) {
            result = finish(parser);
            parser->block_left = 0;
        } else if (parser->block_left) {
            parser->block_left--;
            append(parser, byte);
        } else {
            start_block(parser, byte);
        }
    }
    *n = (uint8_t)(at - bytes);
    return result;
}

uint8_t frame_finish(uint8_t *frame, uint8_t id, uint8_t sequence, uint8_t payload_bytes) {
    uint8_t end = (uint8_t)(payload_bytes + 3);
    uint8_t code_at = 0;
    frame[1] = id;
    frame[2] = sequence;
    uint16_t crc = crc16(frame + 1, (uint8_t)(payload_bytes + 2));
    frame[end++] = (uint8_t)crc;
    frame[end++] = (uint8_t)(crc >> 8);
    for (uint8_t i = 1; i < end; i++) {
        if (frame[i]) continue;
        frame[code_at] = (uint8_t)(i - code_at);
        code_at = i;
    }
    frame[code_at] = (uint8_t)(end - code_at);
    frame[end] = 0;
    return (uint8_t)(end + 1);
}

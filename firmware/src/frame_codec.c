/* COBS framing and CRC-16 of the serial link. */
#include "frame_codec.h"

/* Polynomial 0x1021 a byte at a time, in operations on 8 bits for the AVR. */
static inline crc_t crc_add(crc_t crc, uint8_t byte) {
    uint8_t x = crc.high ^ byte;
    x ^= (uint8_t)(x >> 4);
    crc.high = (uint8_t)(crc.low ^ (uint8_t)(x << 4) ^ (uint8_t)(x >> 3));
    crc.low = (uint8_t)(x ^ (uint8_t)(x << 5));
    return crc;
}

static const crc_t CRC_START = {0xFF, 0xFF};

uint16_t crc16(const uint8_t *data, uint8_t length) {
    crc_t crc = CRC_START;
    while (length--) crc = crc_add(crc, *data++);
    return (uint16_t)(crc.low | (uint16_t)((uint16_t)crc.high << 8));
}

/* The state is kept in locals, which on the AVR are registers. */
parse_t frame_parse(frame_parser_t *parser, const uint8_t *bytes, uint8_t *n) {
    const uint8_t *at = bytes, *end = bytes + *n;
    uint8_t length = parser->started ? parser->length : 0;
    uint8_t left = parser->started ? parser->block_left : 0;
    crc_t crc = parser->started ? parser->crc : CRC_START;
    parse_t result = PARSE_MORE;
    while (at != end) {
        uint8_t byte = *at++;
        if (byte == 0) {
            if (!parser->started) continue; /* delimiters may come in a row */
            parser->started = parser->zero_due = false;
            bool whole = left == 0 && length >= FRAME_OVERHEAD_BYTES && length <= FRAME_MAX_RX_BODY_BYTES;
            result = whole && (crc.high | crc.low) == 0 ? PARSE_FRAME : PARSE_DAMAGED;
            break;
        }
        if (left) {
            left--;
        } else {
            bool zero_due = parser->zero_due;
            parser->started = true;
            parser->zero_due = byte != 0xFF;
            left = (uint8_t)(byte - 1);
            if (!zero_due) continue;
            byte = 0;
        }
        crc = crc_add(crc, byte);
        if (length < FRAME_MAX_RX_BODY_BYTES) parser->body[length] = byte;
        if (length <= FRAME_MAX_RX_BODY_BYTES) length++;
    }
    parser->length = length;
    parser->block_left = left;
    parser->crc = crc;
    *n = (uint8_t)(at - bytes);
    return result;
}

void frame_begin(frame_writer_t *writer, uint8_t *frame, uint8_t id, uint8_t sequence, uint8_t payload_bytes) {
    *writer = (frame_writer_t){.frame = frame, .at = 1, .end = (uint8_t)(payload_bytes + 3), .crc = CRC_START};
    frame[1] = id;
    frame[2] = sequence;
}

static inline uint8_t stuff(uint8_t *frame, uint8_t at, uint8_t code_at) {
    if (frame[at]) return code_at;
    frame[code_at] = (uint8_t)(at - code_at);
    return at;
}

uint8_t frame_work(frame_writer_t *writer, uint8_t budget, bool *done) {
    uint8_t *frame = writer->frame;
    uint8_t at = writer->at, code_at = writer->code_at;
    crc_t crc = writer->crc;
    for (; at != writer->end && budget; at++, budget--) {
        crc = crc_add(crc, frame[at]);
        code_at = stuff(frame, at, code_at);
    }
    writer->at = at;
    writer->code_at = code_at;
    writer->crc = crc;
    *done = at == writer->end;
    if (!*done) return code_at;
    frame[at] = crc.high;
    frame[at + 1] = crc.low;
    code_at = stuff(frame, at, code_at);
    code_at = stuff(frame, (uint8_t)(at + 1), code_at);
    frame[code_at] = (uint8_t)(at + 2 - code_at);
    frame[at + 2] = 0;
    return (uint8_t)(at + 3);
}

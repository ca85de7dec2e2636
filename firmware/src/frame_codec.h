/* COBS framing and CRC-16 of the serial link. */
#ifndef FRAME_CODEC_H
#define FRAME_CODEC_H

#include <stdbool.h>
#include <stdint.h>

#include "frames.h"

typedef struct {
    uint8_t high, low;
} crc_t;

typedef struct {
    uint8_t body[FRAME_MAX_RX_BODY_BYTES]; /* id, sequence, payload, CRC */
    uint8_t length;                        /* bytes in body; above its size: overlong, skip to the delimiter */
    uint8_t block_left;                    /* data bytes until the next COBS code */
    bool started;
    bool zero_due; /* the last block ends in a zero, unless the frame ends there */
    crc_t crc;     /* of the body so far; the check sum, high byte first, leaves 0 */
} frame_parser_t;

typedef enum { PARSE_MORE, PARSE_FRAME, PARSE_DAMAGED } parse_t;

/* CRC-16/CCITT-FALSE over `length` bytes. */
uint16_t crc16(const uint8_t *data, uint8_t length);

/* Takes bytes from the line until a frame ends or none are left; `*n` becomes the bytes taken.
 * On PARSE_FRAME body[0..length) holds a whole frame, valid until the next call. */
parse_t frame_parse(frame_parser_t *parser, const uint8_t *bytes, uint8_t *n);

/* A frame on its way out, made in portions so that a long one does not keep a set-point waiting. */
typedef struct {
    uint8_t *frame;
    uint8_t at, end; /* next byte to work on; where the check sum goes */
    uint8_t code_at; /* the COBS code that waits for its block to end */
    crc_t crc;
} frame_writer_t;

/* Begins the frame whose payload already lies at frame[3]; frame has FRAME_MAX_WIRE_BYTES. */
void frame_begin(frame_writer_t *writer, uint8_t *frame, uint8_t id, uint8_t sequence, uint8_t payload_bytes);

/* Works on at most `budget` bytes. Returns how many bytes of the frame are final; `*done` tells whether that is all. */
uint8_t frame_work(frame_writer_t *writer, uint8_t budget, bool *done);

#endif

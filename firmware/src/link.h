/* The serial link: bytes in from the receiver, whole frames to the commands, frames out to the transmitter. */
#ifndef LINK_H
#define LINK_H

#include <stdbool.h>
#include <stdint.h>

#include "frames.h"
#include "ring.h"

typedef struct {
    ring_t received, sending;
    uint16_t crc_errors, sequence_errors;
    volatile uint16_t rx_overruns;
} serial_t;

extern serial_t serial;

void link_start(void);

/* Interrupt: one byte from the line. `damaged`: the receiver lost or misread a byte before this one. */
static inline void link_receive(uint8_t byte, bool damaged) {
    if (damaged || !ring_put(&serial.received, byte)) serial.rx_overruns++;
}

/* Interrupt: next byte for the line; false when there is none. */
static inline bool link_next_byte(uint8_t *byte) { return ring_get(&serial.sending, byte); }

/* Works through the bytes received; calls command_take() for every whole frame. */
void link_poll(void);

/* Where the payload of the next frame out is to be written, once link_pump() has finished the one before. */
uint8_t *link_payload(void);

/* Sends the payload as frame `id`; link_pump() does the work. Without room in the ring it is dropped: false. */
bool link_send(uint8_t id, uint8_t payload_bytes);

/* Works on the frame out, at most `budget` bytes of it; true while there is more to do. */
bool link_pump(uint8_t budget);

/* Takes the number of this HELLO as the start of the commands' sequence; set-points start anew. */
void link_restart_sequence(uint8_t sequence);

/* Takes the next set-point's number as the start of their sequence. */
void link_restart_setpoints(void);

#endif

/* Byte ring with one writer and one reader, of which one may be an interrupt. */
#ifndef RING_H
#define RING_H

#include <stdbool.h>
#include <stdint.h>

/* 256 bytes, 5 ms of line at 500 kbaud, so that the 8-bit positions wrap by themselves. */
typedef struct {
    volatile uint8_t head; /* next to write */
    volatile uint8_t tail; /* next to read */
    uint8_t bytes[256];
} ring_t;

static inline uint8_t ring_used(const ring_t *ring) { return (uint8_t)(ring->head - ring->tail); }

static inline uint8_t ring_room(const ring_t *ring) { return (uint8_t)(ring->tail - ring->head - 1); }

static inline bool ring_put(ring_t *ring, uint8_t byte) {
    uint8_t head = ring->head, next = (uint8_t)(head + 1);
    if (next == ring->tail) return false;
    ring->bytes[head] = byte;
    ring->head = next;
    return true;
}

static inline bool ring_get(ring_t *ring, uint8_t *byte) {
    uint8_t tail = ring->tail;
    if (tail == ring->head) return false;
    *byte = ring->bytes[tail];
    ring->tail = (uint8_t)(tail + 1);
    return true;
}

#endif

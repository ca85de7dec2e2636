/* Quadrature decoder for all encoders at once: x4, sampled by the step timer. */
#ifndef QUADRATURE_H
#define QUADRATURE_H

#include <stdint.h>

#include "frames.h"

typedef struct {
    int32_t count[AXIS_COUNT];
    int8_t fresh[AXIS_COUNT]; /* counts of the last ms, not yet in count */
    uint16_t errors;   /* both channels changed between two samples */
    uint8_t last_bits; /* A and B of axis 0 in bits 0 and 1, and so on */
} quadrature_t;

extern quadrature_t quadrature;

/* Takes the present lines as the start, without counting. */
void quadrature_start(uint8_t bits);

void quadrature_update_changed(uint8_t bits);

/* Interrupt: one sample. 16000 counts/s, the fastest axis, is below the 20000 samples/s. */
static inline void quadrature_update(uint8_t bits) {
    if (bits != quadrature.last_bits) quadrature_update_changed(bits);
}

/* Counts wrap: an encoder may turn one way for ever. */
static inline int32_t quadrature_sum(int32_t count, int8_t fresh) { return (int32_t)((uint32_t)count + (uint32_t)fresh); }

/* Interrupt, once a ms and axis: moves the fresh counts over. */
static inline void quadrature_fold(uint8_t axis) {
    quadrature.count[axis] = quadrature_sum(quadrature.count[axis], quadrature.fresh[axis]);
    quadrature.fresh[axis] = 0;
}

/* With the interrupts locked. */
static inline int32_t quadrature_count(uint8_t axis) {
    return quadrature_sum(quadrature.count[axis], quadrature.fresh[axis]);
}

static inline void quadrature_set(uint8_t axis, int32_t count) {
    quadrature.count[axis] = count;
    quadrature.fresh[axis] = 0;
}

#endif

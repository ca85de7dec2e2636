/* Quadrature decoder for all encoders at once: x4, sampled by the step timer. */
#include "quadrature.h"

quadrature_t quadrature;

/* Index: old BA in bits 2..3, new BA in bits 0..1. A leads B when counting up; 2 marks an impossible transition. */
static const int8_t TRANSITION[16] = {0, 1, -1, 2, -1, 0, 2, 1, 1, 2, 0, -1, 2, -1, 1, 0};

void quadrature_start(uint8_t bits) { quadrature.last_bits = bits; }

static inline void update_axis(uint8_t axis, uint8_t old, uint8_t bits) {
    int8_t move = TRANSITION[(uint8_t)((old & 3) << 2) | (bits & 3)];
    if (move == 2)
        quadrature.errors++;
    else
        quadrature.fresh[axis] = (int8_t)(quadrature.fresh[axis] + move);
}

void quadrature_update_changed(uint8_t bits) {
    uint8_t old = quadrature.last_bits;
    quadrature.last_bits = bits;
    update_axis(0, old, bits);
    update_axis(1, old >> 2, bits >> 2);
    update_axis(2, old >> 4, bits >> 4);
}

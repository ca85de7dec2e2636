/* Quadrature decoder for all encoders at once: x4, sampled by the step timer. */
#include "quadrature.h"

quadrature_t quadrature;

#define A_BITS 0x15U

void quadrature_start(uint8_t bits) { quadrature.last_bits = bits; }

/* All axes at once, on the A bits: up where the new A differs from the old B (A leads B). */
void quadrature_update_changed(uint8_t bits) {
    uint8_t old = quadrature.last_bits;
    uint8_t changed = bits ^ old;
    uint8_t moved = (changed ^ (uint8_t)(changed >> 1)) & A_BITS;
    uint8_t up = bits ^ (uint8_t)(old >> 1);
    quadrature.last_bits = bits;
    if (moved & 0x01U) quadrature.fresh[0] = (int8_t)(quadrature.fresh[0] + (up & 0x01U ? 1 : -1));
    if (moved & 0x04U) quadrature.fresh[1] = (int8_t)(quadrature.fresh[1] + (up & 0x04U ? 1 : -1));
    if (moved & 0x10U) quadrature.fresh[2] = (int8_t)(quadrature.fresh[2] + (up & 0x10U ? 1 : -1));
    if (changed & (uint8_t)(changed >> 1) & A_BITS) quadrature.errors++;
}

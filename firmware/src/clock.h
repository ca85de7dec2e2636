/* The board's clock: microseconds since the processor started, advanced by the step timer, wraps after 71 minutes. */
#ifndef CLOCK_H
#define CLOCK_H

#include <stdint.h>

#include "interpolator.h"
#include "port.h"

/* In two parts, so that most ticks touch one byte. */
typedef struct {
    uint32_t ms_us; /* start of this ms */
    uint8_t slot;   /* tick within it */
} board_clock_t;

extern board_clock_t board_clock;

/* With the interrupts locked. */
static inline uint32_t clock_locked_us(void) { return board_clock.ms_us + (uint16_t)(board_clock.slot * TICK_US); }

static inline uint32_t clock_now_us(void) {
    port_lock_t lock = port_lock();
    uint32_t now = clock_locked_us();
    port_unlock(lock);
    return now;
}

#endif

/* Step pulses between timed set-points: a Bresenham line an axis and segment, and the ramp that ends every motion. */
#ifndef INTERPOLATOR_H
#define INTERPOLATOR_H

#include <stdbool.h>
#include <stdint.h>

#include "frames.h"

#define TICK_US (1000000UL / TIMER_HZ)
#define TICKS_PER_MS (TIMER_HZ / 1000)
#define QUEUE_SLOTS 8 /* power of two above QUEUE_CAPACITY */
#if HORIZON_US / (1000000UL / TIMER_HZ) > 254
#error "HORIZON_US: a segment's ticks have to fit 8 bits, which keeps the interrupt short"
#endif

typedef enum { MOTION_HOLD, MOTION_SEGMENT, MOTION_RAMP } motion_mode_t;

typedef struct {
    uint16_t end_tick;             /* the position is reached at this tick */
    uint16_t rate_q16[AXIS_COUNT]; /* planned steps per tick, for a ramp that may follow */
    uint16_t target[AXIS_COUNT];   /* low half of the position; a segment is shorter than 32768 steps */
} segment_t;

typedef struct {
    int32_t position;    /* steps made until the last fold */
    int8_t fresh;        /* and since then, at most 1 ms */
    int8_t direction;    /* of the last motion; 0 before the first */
    uint8_t increment;   /* steps in this segment */
    uint8_t accumulator; /* Bresenham remainder */
    uint16_t rate_q16;   /* speed in a ramp, steps per tick */
    uint16_t phase_q16;  /* part of a step made in a ramp */
    uint16_t ramp_q16;   /* loss of speed per ms */
    uint16_t top_q16;    /* the axis' speed limit: a ramp starts no faster */
} axis_motion_t;

typedef struct {
    axis_motion_t axis[AXIS_COUNT];
    segment_t queue[QUEUE_SLOTS];
    volatile uint8_t head, tail; /* head: next to write; tail: next to execute */
    volatile uint8_t mode;       /* motion_mode_t */
    volatile bool ran_dry;       /* a segment ended and none followed */
    uint16_t tick;               /* the board's clock in ticks, wraps */
    uint16_t planned_tick;       /* where the last accepted set-point ends */
    uint8_t segment_ticks;       /* length of the segment in execution */
    uint8_t ticks_left;
    uint8_t ramp_tick; /* within the ms */
    uint8_t direction_bits;
} motion_t;

extern motion_t motion;

void motion_start(void);
void motion_set_limits(uint8_t axis, uint16_t top_q16, uint16_t ramp_q16);

/* Set-points waiting behind the one in execution. */
static inline uint8_t motion_waiting(void) { return (uint8_t)(motion.head - motion.tail) & (QUEUE_SLOTS - 1); }

/* With the interrupts locked: steps made; and the same counter renamed. */
static inline int32_t motion_position(uint8_t axis) { return motion.axis[axis].position + motion.axis[axis].fresh; }
void motion_rename_position(uint8_t axis, int32_t position);

/* With the interrupts locked: speed of an axis that is not in a segment. */
int16_t motion_ramp_speed_q15(uint8_t axis);

/* Where the next segment is to be written; nothing reads it before motion_append(). */
static inline segment_t *motion_free_slot(void) { return &motion.queue[motion.head]; }

/* With the interrupts locked: queues the segment in the free slot. The caller has seen that there is room. */
static inline void motion_append(void) {
    motion.planned_tick = motion.queue[motion.head].end_tick;
    motion.head = (uint8_t)(motion.head + 1) & (QUEUE_SLOTS - 1);
}

/* With the interrupts locked: forgets the queue and decelerates every axis to rest. */
void motion_stop(void);

/* Interrupt, once a ms and axis: moves the fresh steps over. */
static inline void motion_fold(uint8_t axis) {
    motion.axis[axis].position += motion.axis[axis].fresh;
    motion.axis[axis].fresh = 0;
}

/* For motion_tick(): starts the next segment and returns its ticks, or 0 when there is none. */
uint8_t motion_next(void);
uint8_t motion_ramp_tick(void);

static inline uint8_t motion_segment_step(uint8_t index) {
    axis_motion_t *axis = &motion.axis[index];
    uint8_t left = (uint8_t)(axis->accumulator - axis->increment);
    if (axis->accumulator >= axis->increment) {
        axis->accumulator = left;
        return 0;
    }
    axis->accumulator = (uint8_t)(left + motion.segment_ticks);
    axis->fresh = (int8_t)(axis->fresh + axis->direction);
    return (uint8_t)(1 << index);
}

/* Interrupt, once a tick: returns the axes that step in this tick, a bit each. Inlined: it is the hottest path. */
static inline uint8_t motion_tick(void) {
    uint8_t left = motion.ticks_left;
    motion.tick++;
    if (!left) left = motion_next();
    if (!left) return motion.mode == MOTION_RAMP ? motion_ramp_tick() : 0;
    motion.ticks_left = (uint8_t)(left - 1);
    uint8_t steps = motion_segment_step(0);
    steps |= motion_segment_step(1);
    steps |= motion_segment_step(2);
    return steps;
}

#endif

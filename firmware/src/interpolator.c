/* Step pulses between timed set-points: a Bresenham line an axis and segment, and the ramp that ends every motion. */
#include "interpolator.h"

motion_t motion;

void motion_start(void) { motion = (motion_t){0}; }

void motion_set_limits(uint8_t axis, uint16_t top_q16, uint16_t ramp_q16) {
    motion.axis[axis].top_q16 = top_q16;
    motion.axis[axis].ramp_q16 = ramp_q16;
}

void motion_rename_position(uint8_t axis, int32_t position) {
    motion.axis[axis].position = position;
    motion.axis[axis].fresh = 0;
}

int16_t motion_ramp_speed_q15(uint8_t axis) {
    if (motion.mode != MOTION_RAMP) return 0;
    int16_t speed = (int16_t)(motion.axis[axis].rate_q16 >> 1);
    return motion.axis[axis].direction < 0 ? (int16_t)-speed : speed;
}

static inline void load_axis(uint8_t index, const segment_t *segment, uint8_t ticks) {
    axis_motion_t *axis = &motion.axis[index];
    uint16_t distance = (uint16_t)(segment->target[index] - ((uint16_t)axis->position + (uint16_t)axis->fresh));
    uint8_t bit = (uint8_t)(1 << index);
    if (distance & 0x8000U) {
        distance = (uint16_t)(0U - distance);
        axis->direction = -1;
        motion.direction_bits |= bit;
    } else if (distance) {
        axis->direction = 1;
        motion.direction_bits &= (uint8_t)~bit;
    }
    axis->increment = distance > ticks ? ticks : (uint8_t)distance;
    axis->accumulator = ticks >> 1; /* centres the steps in the segment */
}

static inline uint8_t load_segment(void) {
    const segment_t *segment = &motion.queue[motion.tail];
    int16_t left = (int16_t)(segment->end_tick - motion.tick + 1);
    uint8_t ticks = left < 1 ? 1 : left > 255 ? 255 : (uint8_t)left;
    load_axis(0, segment, ticks);
    load_axis(1, segment, ticks);
    load_axis(2, segment, ticks);
    motion.segment_ticks = ticks;
    motion.tail = (uint8_t)(motion.tail + 1) & (QUEUE_SLOTS - 1);
    motion.mode = MOTION_SEGMENT;
    return ticks;
}

static inline void start_ramp_axis(uint8_t index, const segment_t *segment) {
    axis_motion_t *axis = &motion.axis[index];
    uint16_t rate = axis->increment ? segment->rate_q16[index] : 0;
    axis->rate_q16 = rate > axis->top_q16 ? axis->top_q16 : rate;
    axis->phase_q16 = 0x8000;
}

/* From the speed of the segment in execution, which lies in the slot before the tail until QUEUE_SLOTS more came. */
static void start_ramp(void) {
    const segment_t *segment = &motion.queue[(uint8_t)(motion.tail - 1) & (QUEUE_SLOTS - 1)];
    motion.mode = MOTION_RAMP;
    motion.ramp_tick = 0;
    motion.ticks_left = 0;
    start_ramp_axis(0, segment);
    start_ramp_axis(1, segment);
    start_ramp_axis(2, segment);
}

void motion_stop(void) {
    if (motion.mode == MOTION_SEGMENT) start_ramp();
    motion.tail = motion.head;
}

uint8_t motion_next(void) {
    if (motion.head != motion.tail) return load_segment();
    if (motion.mode == MOTION_SEGMENT) {
        motion.ran_dry = true;
        start_ramp();
    }
    return 0;
}

static inline uint8_t ramp_step(uint8_t index) {
    axis_motion_t *axis = &motion.axis[index];
    uint16_t sum = (uint16_t)(axis->phase_q16 + axis->rate_q16);
    bool carry = sum < axis->phase_q16;
    axis->phase_q16 = sum;
    if (!carry) return 0;
    axis->fresh = (int8_t)(axis->fresh + axis->direction);
    return (uint8_t)(1 << index);
}

/* Once a ms an axis loses its share of speed, one axis a tick; then the ramp is over if none moves. */
static inline void ramp_down(void) {
    uint8_t tick = motion.ramp_tick;
    if (tick < AXIS_COUNT) {
        axis_motion_t *axis = &motion.axis[tick];
        axis->rate_q16 = axis->rate_q16 > axis->ramp_q16 ? (uint16_t)(axis->rate_q16 - axis->ramp_q16) : 0;
    } else if (tick == AXIS_COUNT) {
        if (!(motion.axis[0].rate_q16 | motion.axis[1].rate_q16 | motion.axis[2].rate_q16)) motion.mode = MOTION_HOLD;
    }
    motion.ramp_tick = tick + 1 < TICKS_PER_MS ? tick + 1 : 0;
}

uint8_t motion_ramp_tick(void) {
    ramp_down();
    uint8_t steps = ramp_step(0);
    steps |= ramp_step(1);
    steps |= ramp_step(2);
    return steps;
}

/* Which set-points may move the axes: order, time, speed, travel. */
#ifndef SETPOINT_GATE_H
#define SETPOINT_GATE_H

#include <stdbool.h>
#include <stdint.h>

#include "frames.h"

#define TRAVEL_MAX 1000000000L /* steps, to either side of 0: keeps the difference of two positions within 32 bits */

typedef struct {
    bool configured;
    uint16_t speed_q16; /* steps per tick */
    uint16_t mean_q16;  /* the same, of many set-points */
    int32_t soft_min, soft_max;
} axis_limits_t;

typedef struct {
    axis_limits_t axis[AXIS_COUNT];
    int32_t planned[AXIS_COUNT];   /* where the last accepted set-point ends */
    int16_t speed_q15[AXIS_COUNT]; /* and with what speed, steps per tick */
    uint32_t ahead_q16[AXIS_COUNT]; /* steps that the plan is ahead of what the speed limit allows */
    uint16_t counted_tick;          /* until here the speed is accounted for */
    uint16_t last_number;
    bool have_number;
    uint8_t last_reject;
    uint16_t rejected, expired, overflows, late;
} gate_t;

extern gate_t gate;

void gate_start(void);
bool gate_configured(void);
/* Sets the limits of one axis; returns a RESULT_.... */
uint8_t gate_configure(const frame_configure_t *limits);
/* Renames the present position of one axis at rest, within TRAVEL_MAX. With the interrupts locked. */
void gate_rename_position(uint8_t axis, int32_t steps);
/* Forgets the numbers seen: the next set-point starts a new count. */
void gate_rearm(void);
/* Queues the set-point, or refuses and counts it. */
void gate_take(const frame_setpoint_t *setpoint);

#endif

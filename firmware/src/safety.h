/* Safety state machine: deadman, emergency stop, limit switches; faults latch until the operator names them. */
#ifndef SAFETY_H
#define SAFETY_H

#include <stdbool.h>
#include <stdint.h>

#include "frames.h"

/* What the core has to know of the wiring. */
typedef struct {
    bool shared_limits; /* one switch input an axis: the direction of travel tells which end it is */
    bool keep_enabled;  /* the drives stay enabled on a fault, until DISARM: a vertical axis does not fall */
} wiring_t;

typedef struct {
    volatile uint8_t state; /* STATE_... */
    volatile uint8_t fault; /* FAULT_..., the first one since it was last cleared */
    volatile uint8_t inputs; /* debounced switches, a set bit is open */
    uint8_t raw_inputs;
    volatile bool enabled; /* the drives are to be powered */
    wiring_t wiring;
    uint16_t fed_tick;     /* tick of the last accepted set-point */
    uint8_t deadman_age_ms;
    uint16_t underruns;
} safety_t;

extern safety_t safety;

/* `fault` other than FAULT_NONE: the board starts in FAULT (it was reset by its watchdog or a brown-out). */
void safety_start(uint8_t fault, const wiring_t *wiring);

/* With the interrupts locked. */
void safety_trip(uint8_t fault);
void safety_feed(void);

/* Commands; each returns a RESULT_.... */
uint8_t safety_arm(void);
uint8_t safety_disarm(void);
uint8_t safety_clear(uint8_t fault);

/* Interrupt, four times a ms. */
void safety_watch_setpoints(void);

/* Interrupt, once a ms. `raw`: switch lines in the order of INPUT_BIT_.... */
void safety_watch_switches(uint8_t raw);
void safety_settle(void);

#endif

/* The whole board without its hardware: start, one step of the timer interrupt, one turn of the main loop. */
#ifndef CONTROLLER_H
#define CONTROLLER_H

#include <stdbool.h>
#include <stdint.h>

#include "commands.h"
#include "safety.h"

/* Output lines in the result of controller_tick(). */
#define OUTPUT_STEP_MASK 0x07U      /* bit an axis: a step is due */
#define OUTPUT_DIRECTION_SHIFT 3    /* bit an axis: 1 is backwards */
#define OUTPUT_ENABLE 0x40U         /* the drives are to be powered, whatever the level on the pin */

void controller_start(const boot_t *facts, const wiring_t *wiring, uint8_t encoder_bits);

/* Interrupt, every TICK_US. Encoder lines: A, B of axis 0, then 1, then 2.
 * Returns the outputs for the next tick, so that edges leave at the interrupt's entry without jitter. */
uint8_t controller_tick(uint8_t encoder_bits);

/* Main loop: reads what came in, answers, sends the status when it is due. True while there is more to do at once. */
bool controller_poll(void);

#endif

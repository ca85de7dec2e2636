/* The whole board without its hardware: start, one step of the timer interrupt, one turn of the main loop. */
#include "controller.h"

#include "clock.h"
#include "interpolator.h"
#include "link.h"
#include "quadrature.h"
#include "safety.h"
#include "setpoint_gate.h"

#define PORTION_BYTES 12 /* of a frame out between two looks at what came in */

board_clock_t board_clock;
static uint32_t status_due_us;

static uint8_t fault_of_reset(uint8_t cause) {
    if (cause == RESET_CAUSE_WATCHDOG) return FAULT_WATCHDOG;
    return cause == RESET_CAUSE_BROWNOUT ? FAULT_BROWNOUT : FAULT_NONE;
}

void controller_start(const boot_t *facts, const wiring_t *wiring, uint8_t encoder_bits) {
    board_clock = (board_clock_t){0};
    status_due_us = 0;
    link_start();
    gate_start();
    motion_start();
    quadrature = (quadrature_t){0};
    quadrature_start(encoder_bits);
    safety_start(fault_of_reset(facts->reset_cause), wiring);
    commands_start(facts);
}

/* What is due once a ms is spread over its ticks, so that no tick is long. */
static inline void take_slot(uint8_t slot) {
    switch (slot) {
        case 0: board_clock.ms_us += 1000; break;
        case 2: motion_fold(0); break;
        case 4: motion_fold(1); break;
        case 6: motion_fold(2); break;
        case 8: quadrature_fold(0); break;
        case 10: quadrature_fold(1); break;
        case 12: quadrature_fold(2); break;
        case 14: safety_watch_switches(port_read_switches()); break;
        case 16: safety_settle(); break;
        case 3: case 7: case 13: case 17: safety_watch_setpoints(); break;
        default: break;
    }
}

uint8_t controller_tick(uint8_t encoder_bits) {
    uint8_t slot = (uint8_t)(board_clock.slot + 1);
    if (slot == TICKS_PER_MS) slot = 0;
    board_clock.slot = slot;
    quadrature_update(encoder_bits);
    uint8_t steps = motion_tick();
    take_slot(slot);
    uint8_t outputs = (uint8_t)(steps | (uint8_t)(motion.direction_bits << OUTPUT_DIRECTION_SHIFT));
    return safety.enabled ? (uint8_t)(outputs | OUTPUT_ENABLE) : outputs;
}

bool controller_poll(void) {
    link_poll();
    if (link_pump(PORTION_BYTES) || send_answer()) return true;
    uint32_t now_us = clock_now_us();
    if ((int32_t)(now_us - status_due_us) < 0) return false;
    status_due_us += STATUS_PERIOD_US;
    send_status();
    return true;
}

/* The firmware's core on a processor of no cost: every tick of virtual time is one interrupt and one main loop turn. */
#include <stdio.h>
#include <string.h>

#include "board.h"
#include "controller.h"
#include "frames.h"
#include "link.h"
#include "lockstep.h"
#include "port.h"

#define WATCHDOG_CYCLES (60000ULL * CYCLES_PER_US)

typedef struct {
    uint64_t cycle;      /* of the last tick done */
    uint64_t frozen_until; /* 0: running */
    uint16_t boot_count;
    uint32_t starts;
    uint8_t outputs;     /* computed by the last tick, leave with the next one */
    uint32_t enable_changes;
    uint8_t switches;
    bool started;
    encoders_t encoders;
    rx_line_t rx;
    uint8_t tx_byte; /* on the line now */
    bool tx_busy;
    uint64_t tx_done_cycle;
} board_t;

static board_t board;

void port_start_transmitter(void) {}

uint8_t port_read_switches(void) { return board.switches; }

static bool enabled(void) { return board.outputs & OUTPUT_ENABLE; }

static void start(uint8_t cause) {
    wiring_t wiring = {.shared_limits = false, .keep_enabled = BOARD_KEEP_ENABLED};
    boot_t facts = {.boot_count = ++board.boot_count, .reset_cause = cause, .mcu = MCU_NATIVE};
    controller_start(&facts, &wiring, encoders_lines(&board.encoders));
    board.enable_changes += enabled();
    board.outputs = 0;
    board.frozen_until = 0;
    board.tx_busy = false;
    board.starts++;
    board.started = true;
}

static void receive(uint64_t now) {
    uint8_t byte;
    while (rx_line_take(&board.rx, now, &byte)) link_receive(byte, false);
}

/* The transmitter is double buffered: a byte follows the one before without a gap. */
static void transmit(uint64_t now, produce_t *produce) {
    uint8_t byte;
    while (!board.tx_busy || board.tx_done_cycle <= now) {
        uint64_t begin = now;
        if (board.tx_busy) {
            produce_byte(produce, board.tx_done_cycle, board.tx_byte);
            begin = board.tx_done_cycle;
        }
        board.tx_busy = link_next_byte(&byte);
        if (!board.tx_busy) return;
        board.tx_byte = byte;
        board.tx_done_cycle = begin + CYCLES_PER_BYTE;
    }
}

static void tick(produce_t *produce) {
    encoders_run(&board.encoders, board.cycle);
    if (board.frozen_until) {
        if (board.cycle >= board.frozen_until) start(RESET_CAUSE_WATCHDOG);
        return;
    }
    for (unsigned axis = 0; axis < AXES; axis++)
        if (board.outputs & (1U << axis))
            produce_edge(produce, board.cycle, axis, board.outputs >> (OUTPUT_DIRECTION_SHIFT + axis) & 1U);
    receive(board.cycle);
    bool before = enabled();
    board.outputs = controller_tick(encoders_lines(&board.encoders));
    board.enable_changes += enabled() != before;
    while (controller_poll()) {}
    transmit(board.cycle, produce);
}

static void run(const request_t *request, const buffer_t *uart, produce_t *produce) {
    uint64_t until = request->until_us * CYCLES_PER_US;
    board.switches = (uint8_t)((request->limits & 0x3FU) | (request->estop ? 1U << INPUT_BIT_ESTOP : 0U));
    int32_t target[AXES];
    memcpy(target, request->encoder, sizeof target);
    encoders_aim(&board.encoders, target, board.cycle, until);
    if (!board.started) start(RESET_CAUSE_POWER);
    rx_line_send(&board.rx, uart->data, uart->used, board.cycle);
    while (board.cycle + CYCLES_PER_TICK <= until) {
        board.cycle += CYCLES_PER_TICK;
        tick(produce);
    }
}

static void serve(const request_t *request, const buffer_t *uart, produce_t *produce) {
    switch (request->op) {
        case OP_RUN: run(request, uart, produce); break;
        case OP_POWER_CYCLE: start(RESET_CAUSE_POWER); break;
        case OP_RESET: start(RESET_CAUSE_EXTERNAL); break;
        case OP_FREEZE: board.frozen_until = board.cycle + WATCHDOG_CYCLES; break;
        default: break;
    }
}

static reply_t counts(void) {
    return (reply_t){.cycle = board.cycle, .starts = board.starts, .idle_cycles = board.cycle,
                     .enabled = enabled(), .enable_changes = board.enable_changes};
}

int main(void) {
    lockstep_open();
    static request_t request;
    static buffer_t uart;
    static produce_t produce;
    while (request_read(&request, &uart)) {
        serve(&request, &uart, &produce);
        reply_t reply = counts();
        if (!reply_write(&reply, &produce)) return 1;
    }
    return 0;
}

/* The firmware's ELF on a simulated ATmega in lock step with its world.
 *
 * SPDX-License-Identifier: GPL-3.0-or-later
 * This program links libsimavr, which is under the GNU General Public License, version 3; so is this file and the
 * program made from it: you may redistribute and modify it under that licence, version 3 or (at your option) any
 * later one. It comes without any warranty. The other parts of this repository talk to it over pipes only.
 *
 * simavr 1.6 differs from the chip in ways that matter here, so the UART is modelled in this file instead: 10 bits a
 * byte (simavr: 11), a receiver that holds three bytes (64), RXC as long as there is one (pulsed), a double-buffered
 * transmitter. Sleep costs no wall time. Interrupts are entered in no cycles (chip: 4 to 5).
 */
#include <simavr/avr_extint.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "board.h"
#include "frames.h"
#include "lockstep.h"

#define LETTER_(x) #x[0]
#define LETTER(x) LETTER_(x)
#define RECEIVER_BYTES 3 /* two in the FIFO, one in the shift register */
#define RJMP_SELF 0xCFFFU
#define STACK_PAINT 0xC5
#define CYCLES_LIMIT 1000000U /* between two looks at simavr's timers; its own default of 1 is five times slower */

typedef struct {
    const char *name;
    char outputs, encoders, switches;
    unsigned output_shift;
    bool shared_limits, enable_beside_switches;
    uint8_t step_vector; /* TIMER1_COMPA */
    uint16_t mcusr;      /* data address */
} mcu_t;

static const mcu_t MCUS[] = {
    {"atmega2560", LETTER(ATMEGA2560_OUTPUTS), LETTER(ATMEGA2560_ENCODERS), LETTER(ATMEGA2560_SWITCHES),
     ATMEGA2560_OUTPUT_SHIFT, ATMEGA2560_SHARED_LIMITS,
     ATMEGA2560_ENABLE_BESIDE_SWITCHES, 17, 0x54},
    {"atmega328p", LETTER(ATMEGA328P_OUTPUTS), LETTER(ATMEGA328P_ENCODERS), LETTER(ATMEGA328P_SWITCHES),
     ATMEGA328P_OUTPUT_SHIFT, ATMEGA328P_SHARED_LIMITS,
     ATMEGA328P_ENABLE_BESIDE_SWITCHES, 11, 0x54},
};
enum { PORF = 1, EXTRF = 2 };

typedef struct {
    uint8_t held[RECEIVER_BYTES];
    unsigned n;
    bool overrun;
} receiver_t;

typedef struct {
    uint8_t shifting, waiting;
    bool busy, has_waiting;
} transmitter_t;

static struct {
    const mcu_t *mcu;
    avr_t *avr;
    avr_uart_t *uart;
    void (*core_reset)(avr_t *);
    uint64_t base_cycle, reset_cycle; /* some versions of simavr start their count anew with each reset */
    bool was_reset;
    uint8_t outputs;
    uint8_t enable_port, enable_direction; /* registers of the port that carries the enable line */
    uint8_t encoder_lines, switches; /* on the pins */
    encoders_t encoders;
    rx_line_t rx_line;
    receiver_t receiver;
    transmitter_t transmitter;
    produce_t produce;
    reply_t count;
    avr_cycle_count_t isr_entered;
    avr_flashaddr_t frozen_pc;
    uint16_t frozen_code;
    bool frozen;
    uint16_t variables_end; /* data address */
} board;

static uint64_t now(void) { return board.base_cycle + board.avr->cycle; }

/* --- UART ------------------------------------------------------------------------------------------------------- */

static uint8_t read_data(avr_t *avr, avr_io_addr_t address, void *param) {
    (void)param;
    receiver_t *receiver = &board.receiver;
    uint8_t byte = 0;
    if (receiver->n) {
        byte = receiver->held[0];
        receiver->n--;
        memmove(receiver->held, receiver->held + 1, receiver->n);
    }
    avr_regbit_clear(avr, board.uart->dor);
    avr_clear_interrupt(avr, &board.uart->rxc);
    avr_regbit_clear(avr, board.uart->rxc.raised);
    if (receiver->n) avr_raise_interrupt(avr, &board.uart->rxc);
    avr->data[address] = byte;
    return byte;
}

static avr_cycle_count_t byte_arrives(avr_t *avr, avr_cycle_count_t when, void *param) {
    (void)param;
    uint8_t byte;
    if (!rx_line_take(&board.rx_line, board.base_cycle + when, &byte)) return 0;
    if (!avr_regbit_get(avr, board.uart->rxen)) {
        board.count.rx_lost++;
    } else if (board.receiver.n == RECEIVER_BYTES) {
        board.count.rx_lost++;
        avr_regbit_set(avr, board.uart->dor);
    } else {
        board.receiver.held[board.receiver.n++] = byte;
        avr_raise_interrupt(avr, &board.uart->rxc);
    }
    return rx_line_idle(&board.rx_line) ? 0 : (avr_cycle_count_t)(board.rx_line.ready_cycle - board.base_cycle);
}

static void expect_byte(void) {
    if (rx_line_idle(&board.rx_line)) return;
    uint64_t ready = board.rx_line.ready_cycle;
    avr_cycle_timer_register(board.avr, ready > now() ? ready - now() : 1, byte_arrives, NULL);
}

static avr_cycle_count_t byte_sent(avr_t *avr, avr_cycle_count_t when, void *param) {
    (void)param;
    transmitter_t *transmitter = &board.transmitter;
    produce_byte(&board.produce, board.base_cycle + when, transmitter->shifting);
    transmitter->busy = transmitter->has_waiting;
    if (!transmitter->busy) return 0;
    transmitter->shifting = transmitter->waiting;
    transmitter->has_waiting = false;
    avr_raise_interrupt(avr, &board.uart->udrc);
    return when + CYCLES_PER_BYTE;
}

static void write_data(avr_t *avr, avr_io_addr_t address, uint8_t byte, void *param) {
    (void)address;
    (void)param;
    transmitter_t *transmitter = &board.transmitter;
    if (!transmitter->busy) {
        transmitter->busy = true;
        transmitter->shifting = byte;
        avr_cycle_timer_register(avr, CYCLES_PER_BYTE, byte_sent, NULL);
        avr_raise_interrupt(avr, &board.uart->udrc);
        return;
    }
    transmitter->waiting = byte;
    transmitter->has_waiting = true;
    avr_clear_interrupt(avr, &board.uart->udrc);
    avr_regbit_clear(avr, board.uart->udrc.raised);
}

static void write_control(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    bool was_enabled = avr_regbit_get(avr, board.uart->udrc.enable);
    avr->data[address] = value;
    bool enabled = avr_regbit_get(avr, board.uart->udrc.enable);
    if (enabled && !was_enabled && !board.transmitter.has_waiting) avr_raise_interrupt(avr, &board.uart->udrc);
}

/* The board's divisor must be that of the line: 16 MHz / 8 / 500 kbaud, with U2X. */
static void write_divisor(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    avr->data[address] = value;
    if (value == 3 && avr_regbit_get(avr, board.uart->u2x)) return;
    fprintf(stderr, "avr_board: found UART divisor %u, wanted 3 with U2X set before\n", value);
    exit(1);
}

static void take_over_uart(void) {
    avr_io_t *io = board.avr->io_port;
    while (io && !(strcmp(io->kind, "uart") == 0 && ((avr_uart_t *)io)->name == '0')) io = io->next;
    if (!io) {
        fprintf(stderr, "avr_board: simavr gives %s no UART 0\n", board.mcu->name);
        exit(1);
    }
    avr_uart_t *uart = board.uart = (avr_uart_t *)io;
    board.avr->io[AVR_DATA_TO_IO(uart->r_udr)].r.c = read_data;
    board.avr->io[AVR_DATA_TO_IO(uart->r_udr)].w.c = write_data;
    board.avr->io[AVR_DATA_TO_IO(uart->r_ucsrb)].w.c = write_control;
    board.avr->io[AVR_DATA_TO_IO(uart->ubrrl.reg)].w.c = write_divisor;
    uart->flags = 0;
}

/* --- pins ------------------------------------------------------------------------------------------------------- */

static void drive(char port, uint8_t *on_pins, uint8_t lines) {
    avr_ioport_external_t external = {.name = (unsigned long)port & 0x7FU, .mask = 0xFF, .value = lines};
    avr_ioctl(board.avr, AVR_IOCTL_IOPORT_SET_EXTERNAL(port), &external);
    for (int pin = 0; pin < 8; pin++)
        if ((lines ^ *on_pins) >> pin & 1U)
            avr_raise_irq(avr_io_getirq(board.avr, AVR_IOCTL_IOPORT_GETIRQ(port), pin), lines >> pin & 1U);
    *on_pins = lines;
}

static avr_cycle_count_t encoders_move(avr_t *avr, avr_cycle_count_t when, void *param) {
    (void)avr;
    (void)param;
    if (encoders_run(&board.encoders, board.base_cycle + when))
        drive(board.mcu->encoders, &board.encoder_lines, encoders_lines(&board.encoders));
    return (avr_cycle_count_t)(board.encoders.next_cycle - board.base_cycle);
}

static void outputs_written(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    (void)param;
    uint8_t outputs = (uint8_t)(value >> board.mcu->output_shift);
    uint8_t rising = outputs & (uint8_t)~board.outputs;
    for (unsigned axis = 0; axis < AXES; axis++)
        if (rising >> axis & 1U) produce_edge(&board.produce, now(), axis, outputs >> (AXES + axis) & 1U);
    board.outputs = outputs;
}

/* As a driver sees the line. While the pin is an input, a pull resistor holds it at the level that is off. */
static bool enabled(void) {
    unsigned pin = board.mcu->enable_beside_switches ? BOARD_ENABLE_PIN_BESIDE : BOARD_ENABLE_BIT + board.mcu->output_shift;
    bool driven = board.enable_direction >> pin & 1U, high = board.enable_port >> pin & 1U;
    return driven && high != BOARD_ENABLE_ACTIVE_LOW;
}

static struct avr_irq_t *enable_irqs(void) {
    char port = board.mcu->enable_beside_switches ? board.mcu->switches : board.mcu->outputs;
    return avr_io_getirq(board.avr, AVR_IOCTL_IOPORT_GETIRQ(port), 0);
}

static void watch_enable(uint8_t *reg, uint8_t value) {
    bool before = board.count.enabled;
    *reg = value;
    board.count.enabled = enabled();
    board.count.enable_changes += board.count.enabled != before;
}

static void enable_port_written(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    (void)param;
    watch_enable(&board.enable_port, (uint8_t)value);
}

static void enable_direction_written(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    (void)param;
    watch_enable(&board.enable_direction, (uint8_t)value);
}

/* Levels of the switches' lines. Shared inputs are both ends of an axis: in series where they are normally closed. */
static uint8_t switch_lines(const request_t *request) {
    uint8_t limits = request->limits & 0x3FU;
    uint8_t hit = (uint8_t)(limits | (request->estop ? 1U << INPUT_BIT_ESTOP : 0U));
    if (!board.mcu->shared_limits) return hit ^ BOARD_NORMALLY_OPEN;
    uint8_t lines = request->estop ? 1U << AXES : 0U;
    for (unsigned axis = 0; axis < AXES; axis++)
        if (limits >> (2 * axis) & 3U) lines |= (uint8_t)(1U << axis);
    return lines ^ BOARD_SHARED_LINES(BOARD_NORMALLY_OPEN);
}

/* --- processor -------------------------------------------------------------------------------------------------- */

static void step_isr(struct avr_irq_t *irq, uint32_t running, void *param) {
    (void)irq;
    (void)param;
    if (running) {
        board.isr_entered = board.avr->cycle;
        return;
    }
    uint32_t cycles = (uint32_t)(board.avr->cycle - board.isr_entered);
    board.count.isr_cycles += cycles;
    board.count.isr_count++;
    if (cycles > board.count.isr_max_cycles) board.count.isr_max_cycles = cycles;
}

static void sleep_free(avr_t *avr, avr_cycle_count_t cycles) {
    (void)avr;
    board.count.idle_cycles += cycles;
}

static void on_reset(avr_t *avr) {
    board.was_reset = true;
    board.reset_cycle = now();
    board.receiver = (receiver_t){0};
    board.transmitter = (transmitter_t){0};
    board.outputs = 0;
    /* The pins are inputs again. simavr does not say so, and passes on only values that differ from the last. */
    struct avr_irq_t *pins = enable_irqs();
    avr_raise_irq(pins + IOPORT_IRQ_DIRECTION_ALL, 0);
    avr_raise_irq(pins + IOPORT_IRQ_REG_PORT, 0);
    if (board.frozen) memcpy(avr->flash + board.frozen_pc, &board.frozen_code, sizeof board.frozen_code);
    board.frozen = false;
    board.count.starts++;
    if (board.core_reset) board.core_reset(avr);
}

/* Bytes above the variables that no push has reached since the paint. */
static uint32_t stack_free(void) {
    uint32_t address = board.variables_end;
    while (address <= board.avr->ramend && board.avr->data[address] == STACK_PAINT) address++;
    return address - board.variables_end;
}

static void note_stack(void) {
    uint32_t free_bytes = stack_free();
    if (free_bytes < board.count.stack_free) board.count.stack_free = free_bytes;
}

/* A low level on an external interrupt's pin makes simavr poll it every cycle, enabled or not. */
static void stop_level_polling(void) {
    for (uint8_t i = 0; i < EXTINT_COUNT; i++)
        if (avr_extint_is_strict_lvl_trig(board.avr, i) > 0) avr_extint_set_strict_lvl_trig(board.avr, i, 0);
}

/* simavr forgets its timers, the pins and its settings with a reset. */
static void after_reset(void) {
    board.was_reset = false;
    memset(board.avr->data + board.variables_end, STACK_PAINT, board.avr->ramend + 1U - board.variables_end);
    board.base_cycle = board.reset_cycle - board.avr->cycle;
    board.avr->run_cycle_limit = CYCLES_LIMIT;
    stop_level_polling();
    uint8_t encoder_lines = board.encoder_lines, switches = board.switches;
    /* To the other level and back: simavr passes on only levels that differ from the last. */
    drive(board.mcu->encoders, &board.encoder_lines, (uint8_t)~encoder_lines);
    drive(board.mcu->switches, &board.switches, (uint8_t)~switches);
    drive(board.mcu->encoders, &board.encoder_lines, encoder_lines);
    drive(board.mcu->switches, &board.switches, switches);
    uint64_t next = board.encoders.next_cycle;
    avr_cycle_timer_register(board.avr, next > now() ? next - now() : 1, encoders_move, NULL);
    expect_byte();
}

static void restart(uint8_t cause_flag) {
    avr_reset(board.avr);
    board.avr->data[board.mcu->mcusr] = cause_flag;
    after_reset();
}

static avr_cycle_count_t slice_ends(avr_t *avr, avr_cycle_count_t when, void *param) {
    (void)avr;
    (void)when;
    (void)param;
    return 0;
}

static void run(const request_t *request, const buffer_t *uart) {
    uint64_t until = request->until_us * CYCLES_PER_US;
    int32_t target[AXES];
    memcpy(target, request->encoder, sizeof target);
    bool first = !board.encoders.placed;
    encoders_aim(&board.encoders, target, now(), until);
    drive(board.mcu->switches, &board.switches, switch_lines(request));
    if (first) {
        board.encoder_lines = encoders_lines(&board.encoders);
        restart(PORF);
    }
    bool idle = rx_line_idle(&board.rx_line);
    rx_line_send(&board.rx_line, uart->data, uart->used, now());
    if (idle) expect_byte();
    while (now() < until) {
        avr_cycle_timer_register(board.avr, until - now(), slice_ends, NULL);
        while (now() < until && !board.was_reset) {
            int state = avr_run(board.avr);
            if (state != cpu_Done && state != cpu_Crashed) continue;
            fprintf(stderr, "avr_board: the simulated processor crashed at %#x\n", (unsigned)board.avr->pc);
            exit(1);
        }
        if (board.was_reset) after_reset();
    }
}

/* The program counter gets a jump to itself, and no interrupt comes any more. */
static void freeze(void) {
    uint16_t code = RJMP_SELF;
    board.frozen = true;
    board.frozen_pc = board.avr->pc;
    memcpy(&board.frozen_code, board.avr->flash + board.frozen_pc, sizeof code);
    memcpy(board.avr->flash + board.frozen_pc, &code, sizeof code);
    board.avr->sreg[S_I] = 0;
    board.avr->state = cpu_Running;
}

static void serve(const request_t *request, const buffer_t *uart) {
    switch (request->op) {
        case OP_RUN: run(request, uart); break;
        case OP_POWER_CYCLE: restart(PORF); break;
        case OP_RESET: restart(EXTRF); break;
        case OP_FREEZE: freeze(); break;
        default: break;
    }
}

static void quiet(avr_t *avr, const int level, const char *format, va_list arguments) {
    (void)avr;
    if (level <= LOG_ERROR) vfprintf(stderr, format, arguments);
}

static void watch(void) {
    avr_irq_register_notify(avr_io_getirq(board.avr, AVR_IOCTL_IOPORT_GETIRQ(board.mcu->outputs), IOPORT_IRQ_REG_PORT),
                            outputs_written, NULL);
    avr_irq_register_notify(enable_irqs() + IOPORT_IRQ_REG_PORT, enable_port_written, NULL);
    avr_irq_register_notify(enable_irqs() + IOPORT_IRQ_DIRECTION_ALL, enable_direction_written, NULL);
    avr_int_table_t *table = &board.avr->interrupts;
    for (int i = 0; i < table->vector_count; i++)
        if (table->vector[i]->vector == board.mcu->step_vector)
            avr_irq_register_notify(table->vector[i]->irq + AVR_INT_IRQ_RUNNING, step_isr, NULL);
}

static bool start(const char *name, const char *elf) {
    for (size_t i = 0; i < sizeof MCUS / sizeof MCUS[0]; i++)
        if (strcmp(MCUS[i].name, name) == 0) board.mcu = &MCUS[i];
    static elf_firmware_t firmware;
    if (!board.mcu || elf_read_firmware(elf, &firmware) != 0) return false;
    avr_t *avr = board.avr = avr_make_mcu_by_name(name);
    if (!avr || avr_init(avr) != 0) return false;
    firmware.frequency = BOARD_CPU_HZ;
    board.count.stack_free = UINT32_MAX;
    for (uint32_t i = 0; i < firmware.symbolcount; i++)
        if (strcmp(firmware.symbol[i]->symbol, "_end") == 0) board.variables_end = (uint16_t)firmware.symbol[i]->addr;
    if (!board.variables_end) return false;
    avr_load_firmware(avr, &firmware);
    avr->log = LOG_ERROR;
    avr->sleep = sleep_free;
    board.core_reset = avr->reset;
    avr->reset = on_reset;
    take_over_uart();
    watch();
    return true;
}

int main(int argc, char **argv) {
    lockstep_open();
    avr_global_logger_set(quiet);
    if (argc != 3 || !start(argv[1], argv[2])) {
        fprintf(stderr, "usage: avr_board atmega2560|atmega328p FIRMWARE.elf\n");
        return 2;
    }
    static request_t request;
    static buffer_t uart;
    while (request_read(&request, &uart)) {
        serve(&request, &uart);
        note_stack();
        reply_t reply = board.count;
        reply.cycle = now();
        if (!reply_write(&reply, &board.produce)) return 1;
    }
    return 0;
}

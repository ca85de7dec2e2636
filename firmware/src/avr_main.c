/* The thin layer on the AVR: pins, step timer, UART, EEPROM, watchdog. */
#ifdef __AVR__
#include "avr_main.h"

#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "board.h"
#include "controller.h"
#include "frames.h"
#include "interpolator.h"
#include "link.h"
#include "port.h"

#if F_CPU != 16000000UL
#error "F_CPU: wanted 16 MHz"
#endif

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define PORT_OF(word) JOIN(PORT, BOARD(word))
#define PIN_OF(word) JOIN(PIN, BOARD(word))
#define DDR_OF(word) JOIN(DDR, BOARD(word))
#define OUTPUT_SHIFT BOARD(OUTPUT_SHIFT)

/* U2X: 500 kbaud divides 16 MHz exactly. */
#define UART_DIVISOR (F_CPU / 8 / BAUD - 1)

#ifdef __AVR_ATmega328P__ /* its only UART has no number */
#define USART0_RX_vect USART_RX_vect
#define USART0_UDRE_vect USART_UDRE_vect
#endif

#define ENABLE_BESIDE BOARD(ENABLE_BESIDE_SWITCHES)
#define ENABLE_INVERT (BOARD_ENABLE_ACTIVE_LOW ? OUTPUT_ENABLE : 0U)
#if BOARD(SHARED_LIMITS)
#define OPEN_LINES BOARD_SHARED_LINES(BOARD_NORMALLY_OPEN)
#else
#define OPEN_LINES BOARD_NORMALLY_OPEN
#endif

static uint8_t outputs; /* what the next tick puts on the outputs' port */
static uint8_t reset_flags __attribute__((section(".noinit")));

/* Before main: the watchdog that reset us is still on, with its shortest time. */
void save_reset_flags(void) __attribute__((naked, used, section(".init3")));
void save_reset_flags(void) {
    reset_flags = MCUSR;
    MCUSR = 0;
    wdt_disable();
}

static uint8_t reset_cause(void) {
    if (reset_flags & _BV(PORF)) return RESET_CAUSE_POWER;
    if (reset_flags & _BV(WDRF)) return RESET_CAUSE_WATCHDOG;
    if (reset_flags & _BV(BORF)) return RESET_CAUSE_BROWNOUT;
    return RESET_CAUSE_EXTERNAL;
}

static uint16_t count_boot(void) {
    uint16_t *address = (uint16_t *)BOARD_BOOT_COUNT_ADDRESS;
    uint16_t count = (uint16_t)(eeprom_read_word(address) + 1);
    if (count == 0) count = 1; /* erased EEPROM reads 0xFFFF */
    eeprom_update_word(address, count);
    return count;
}

/* Levels before directions: the enable line never has the level that powers the drives. */
static void start_pins(void) {
    uint8_t beside = ENABLE_BESIDE ? _BV(BOARD_ENABLE_PIN_BESIDE) : 0;
    PORT_OF(SWITCHES) = (uint8_t)(BOARD_SWITCH_MASK | (BOARD_ENABLE_ACTIVE_LOW ? beside : 0)); /* pull-ups */
    DDR_OF(SWITCHES) = beside;
    PORT_OF(ENCODERS) = BOARD_ENCODER_MASK;
    PORT_OF(OUTPUTS) = (uint8_t)((ENABLE_INVERT & BOARD_OUTPUT_MASK) << OUTPUT_SHIFT);
    DDR_OF(OUTPUTS) = (uint8_t)(BOARD_OUTPUT_MASK << OUTPUT_SHIFT);
}

/* The value of the outputs' port. */
static inline uint8_t port_value(uint8_t lines) {
    return (uint8_t)((uint8_t)((lines ^ ENABLE_INVERT) & BOARD_OUTPUT_MASK) << OUTPUT_SHIFT);
}

#if ENABLE_BESIDE
/* One instruction each, so that the pull-ups beside it are not touched. */
static inline void write_enable_beside(uint8_t lines) {
    if ((lines ^ ENABLE_INVERT) & OUTPUT_ENABLE)
        PORT_OF(SWITCHES) |= _BV(BOARD_ENABLE_PIN_BESIDE);
    else
        PORT_OF(SWITCHES) &= (uint8_t)~_BV(BOARD_ENABLE_PIN_BESIDE);
}
#endif

static void start_uart(void) {
    UCSR0A = _BV(U2X0); /* before the divisor: simavr times the line when that is written */
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UBRR0H = 0;
    UBRR0L = UART_DIVISOR;
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
}

static void start_timer(void) {
    TCCR1A = 0; /* the Arduino core leaves it in a PWM mode */
    TCCR1B = 0;
    TCNT1 = 0;
    OCR1A = F_CPU / TIMER_HZ - 1;
    TIFR1 = _BV(OCF1A);
    TIMSK1 = _BV(OCIE1A);
    TCCR1B = _BV(WGM12) | _BV(CS10);
}

static uint8_t encoder_lines(void) { return PIN_OF(ENCODERS) & BOARD_ENCODER_MASK; }

void firmware_setup(void) {
    cli();
    TIMSK0 = 0; /* the Arduino core's millis() would disturb the step timer */
    start_pins();
    boot_t facts = {.boot_count = count_boot(), .reset_cause = reset_cause(), .mcu = BOARD_MCU};
    wiring_t wiring = {.shared_limits = BOARD(SHARED_LIMITS), .keep_enabled = BOARD_KEEP_ENABLED};
    controller_start(&facts, &wiring, encoder_lines());
    outputs = port_value(0);
    start_uart();
    start_timer();
    set_sleep_mode(SLEEP_MODE_IDLE);
    wdt_enable(WDTO_60MS); /* the Mega's first bootloaders hang after a reset by it: use one that turns it off */
    sei();
}

void firmware_loop(void) {
    static uint8_t seen_tick;
    uint8_t tick = (uint8_t)motion.tick;
    if (tick != seen_tick) wdt_reset(); /* both the main loop and the step timer must live */
    seen_tick = tick;
    if (!controller_poll()) sleep_mode(); /* until the next interrupt, at most one tick */
}

uint8_t port_read_switches(void) {
#if BOARD(SHARED_LIMITS)
    static const uint8_t BOTH_ENDS[8] = {0x00, 0x03, 0x0C, 0x0F, 0x30, 0x33, 0x3C, 0x3F};
    uint8_t lines = (PIN_OF(SWITCHES) & BOARD_SWITCH_MASK) ^ OPEN_LINES;
    return (uint8_t)(BOTH_ENDS[lines & 7] | (lines & 8 ? _BV(INPUT_BIT_ESTOP) : 0));
#else
    return (PIN_OF(SWITCHES) & BOARD_SWITCH_MASK) ^ OPEN_LINES;
#endif
}

void port_start_transmitter(void) { UCSR0B |= _BV(UDRIE0); }

/* Steps leave first, so that their edges do not depend on the work that follows; they end with it, 8 us or later. */
ISR(TIMER1_COMPA_vect) {
    PORT_OF(OUTPUTS) = outputs;
    uint8_t lines = controller_tick(encoder_lines());
    outputs = port_value(lines);
    PORT_OF(OUTPUTS) = outputs & (uint8_t)~(OUTPUT_STEP_MASK << OUTPUT_SHIFT);
#if ENABLE_BESIDE
    static uint8_t written;
    if ((lines ^ written) & OUTPUT_ENABLE) write_enable_beside(lines);
    written = lines;
#endif
}

ISR(USART0_RX_vect) {
    bool damaged = UCSR0A & (_BV(FE0) | _BV(DOR0));
    link_receive(UDR0, damaged);
}

ISR(USART0_UDRE_vect) {
    uint8_t byte;
    if (link_next_byte(&byte))
        UDR0 = byte;
    else
        UCSR0B &= (uint8_t)~_BV(UDRIE0);
}

#ifndef ARDUINO
int main(void) {
    firmware_setup();
    for (;;) firmware_loop();
}
#endif
#endif

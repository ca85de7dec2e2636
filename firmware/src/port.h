/* What the core needs of the processor it runs on: short critical sections, switches, a nudge to the transmitter. */
#ifndef PORT_H
#define PORT_H

#include <stdint.h>

typedef uint8_t port_lock_t;

#ifdef __AVR__
#include <avr/interrupt.h>
#include <avr/io.h>

static inline port_lock_t port_lock(void) {
    port_lock_t saved = SREG;
    cli();
    return saved;
}

static inline void port_unlock(port_lock_t saved) {
    __asm__ volatile("" ::: "memory");
    SREG = saved;
}
#else
static inline port_lock_t port_lock(void) { return 0; }
static inline void port_unlock(port_lock_t saved) { (void)saved; }
#endif

/* Switch lines in the order of INPUT_BIT_...; a set bit is open. Called from the step timer's interrupt. */
uint8_t port_read_switches(void);

/* Bytes wait in the transmit ring: the processor's layer starts to fetch them with link_next_byte(). */
void port_start_transmitter(void);

#endif

/* Pins and limits of the boards. One word a port: the port's letter; the simulated board reads the same words.
 *
 * Inputs have ports of their own: an input with a pull-up beside outputs is rewritten by simavr with every output.
 * Other ports and polarities come from the rig file's [board.pins]: the Makefile's PINS defines these words before.
 * Switches connect to ground, with the pull-up on. A normally closed one opens when it is hit, and so does a broken
 * wire: the line reads 1. Those named in BOARD_NORMALLY_OPEN close when they are hit: the line reads 0.
 * ENABLE is low when the drives are to be powered (A4988, DRV8825, TMC2209), or high with BOARD_ENABLE_ACTIVE_LOW 0.
 *
 *                 ATmega2560 (Arduino Mega)                 ATmega328P (Uno, Nano)
 * STEP 0 1 2      PA0 PA1 PA2   D22 D23 D24                 PD2 PD3 PD4   D2 D3 D4
 * DIR  0 1 2      PA3 PA4 PA5   D25 D26 D27  1: backwards   PD5 PD6 PD7   D5 D6 D7
 * ENABLE          PA6           D28                         PB4           D12, beside the switches
 * encoder A,B     PC0..PC5      D37..D32                    PC0..PC5      A0..A5
 * limits min,max  PL0..PL5      D49..D44                    PB0 PB1 PB2   D8 D9 D10, both ends of an axis in series
 * emergency stop  PL6           D43                         PB3           D11
 */
#ifndef BOARD_H
#define BOARD_H

#ifndef ATMEGA2560_OUTPUTS
#define ATMEGA2560_OUTPUTS A
#endif
#ifndef ATMEGA2560_OUTPUT_SHIFT
#define ATMEGA2560_OUTPUT_SHIFT 0
#endif
#ifndef ATMEGA2560_ENCODERS
#define ATMEGA2560_ENCODERS C
#endif
#ifndef ATMEGA2560_SWITCHES
#define ATMEGA2560_SWITCHES L
#endif
#define ATMEGA2560_SHARED_LIMITS 0
#define ATMEGA2560_ENABLE_BESIDE_SWITCHES 0 /* beside step and direction */

#ifndef ATMEGA328P_OUTPUTS
#define ATMEGA328P_OUTPUTS D
#endif
#ifndef ATMEGA328P_OUTPUT_SHIFT
#define ATMEGA328P_OUTPUT_SHIFT 2
#endif
#ifndef ATMEGA328P_ENCODERS
#define ATMEGA328P_ENCODERS C
#endif
#ifndef ATMEGA328P_SWITCHES
#define ATMEGA328P_SWITCHES B
#endif
#define ATMEGA328P_SHARED_LIMITS 1
#define ATMEGA328P_ENABLE_BESIDE_SWITCHES 1 /* the outputs' port has no pin left */

#ifndef BOARD_ENABLE_ACTIVE_LOW
#define BOARD_ENABLE_ACTIVE_LOW 1
#endif
#ifndef BOARD_NORMALLY_OPEN
#define BOARD_NORMALLY_OPEN 0x00 /* INPUT_BIT_... of the switches that close when they are hit */
#endif
#ifndef BOARD_KEEP_ENABLED
#define BOARD_KEEP_ENABLED 0 /* 1: the drives stay enabled on a fault, until DISARM */
#endif
#define BOARD_ENABLE_BIT 6      /* among the outputs */
#define BOARD_ENABLE_PIN_BESIDE 4 /* of the switches' port, where it is beside these */
/* BOARD_NORMALLY_OPEN as lines of the switches' port: both ends of an axis share one, the emergency stop follows. */
#define BOARD_SHARED_LINES(inputs) ((inputs & 1) | (inputs >> 1 & 2) | (inputs >> 2 & 4) | (inputs >> 3 & 8))

#define BOARD_CPU_HZ 16000000UL
#define BOARD_ENCODER_MASK 0x3F
#define BOARD_BOOT_COUNT_ADDRESS 0 /* EEPROM, u16 */

#if defined(__AVR_ATmega2560__)
#define BOARD(word) ATMEGA2560_##word
#define BOARD_MCU MCU_ATMEGA2560
#define BOARD_SWITCH_MASK 0x7F
#define BOARD_OUTPUT_MASK 0x7F
#elif defined(__AVR_ATmega328P__)
#define BOARD(word) ATMEGA328P_##word
#define BOARD_MCU MCU_ATMEGA328P
#define BOARD_SWITCH_MASK 0x0F
#define BOARD_OUTPUT_MASK 0x3F
#elif defined(__AVR__)
#error "board.h has no pins for this processor: wanted ATmega2560 or ATmega328P"
#endif

#endif

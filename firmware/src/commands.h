/* What the board does with each frame from the host, and what it tells of itself. */
#ifndef COMMANDS_H
#define COMMANDS_H

#include <stdbool.h>
#include <stdint.h>

/* Facts about this start of the processor. */
typedef struct {
    uint16_t boot_count;
    uint8_t reset_cause; /* RESET_CAUSE_... */
    uint8_t mcu;         /* MCU_... */
} boot_t;

extern boot_t boot;

void commands_start(const boot_t *facts);

/* Whether `id` is a frame to the board and has this many bytes of payload. */
bool command_fits(uint8_t id, uint8_t payload_bytes);

/* Executes one whole frame; its answer waits for send_answer(). */
void command_take(uint8_t id, uint8_t sequence, const uint8_t *payload);

/* With no frame out in the making: begins the oldest answer; false when none waits. */
bool send_answer(void);
void send_status(void);

#endif

/* Lock step between a simulated board (child process) and its world (parent): one request, one reply, over pipes.
 *
 * The parent says until when to run, with what on the inputs; the child answers with what left the outputs on the
 * way. Same requests, same replies. All integers little endian; the structs below are the wire format.
 */
#ifndef LOCKSTEP_H
#define LOCKSTEP_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define AXES 3
#define CYCLES_PER_US 16U
#define CYCLES_PER_TICK 800U /* step timer, 20 kHz */
#define CYCLES_PER_BYTE 320U /* 500 kbaud, 10 bits */
#define CYCLES_PER_COUNT 1000U /* 16000 counts/s, the fastest axis; the board samples every tick */
#define COUNTS_OF_JITTER 4 /* by which a rotor may be ahead in one slice without turning faster than that */

enum {
    OP_RUN = 'X',
    OP_POWER_CYCLE = 'P',
    OP_RESET = 'R', /* the reset pin */
    OP_FREEZE = 'F', /* the processor hangs until its watchdog resets it */
};

typedef struct __attribute__((packed)) {
    uint8_t op;
    uint8_t estop; /* 1: hit, whatever level the switch then gives */
    uint16_t limits; /* bit 2*axis: lower end, 2*axis+1: upper end; 1: hit */
    uint32_t uart_bytes; /* follow this struct */
    uint64_t until_us; /* since the child started */
    int32_t encoder[AXES]; /* counts to be reached when the slice ends */
} request_t;

typedef struct __attribute__((packed)) {
    uint64_t cycle; /* where the board stopped */
    uint64_t isr_cycles, isr_count; /* step timer's interrupt, since the child started */
    uint64_t idle_cycles;
    uint32_t isr_max_cycles;
    uint32_t starts; /* of the processor */
    uint32_t rx_lost; /* bytes the receiver had no room for */
    uint32_t stack_free; /* bytes between the variables and the deepest stack so far; native: 0 */
    uint32_t enabled; /* 1: the enable line powers the drives; a pin that is not driven does not (pull resistor) */
    uint32_t enable_changes; /* since the child started */
    uint32_t uart_bytes, edges; /* follow: the bytes, the u64 cycle each had left whole, then the edges */
} reply_t;

typedef struct __attribute__((packed)) {
    uint64_t cycle;
    uint8_t axis;
    int8_t sign;
} edge_t;

/* Growing array of bytes. */
typedef struct {
    uint8_t *data;
    size_t used, room;
} buffer_t;

void buffer_add(buffer_t *buffer, const void *data, size_t n);

/* Bytes on their way to the board, one every CYCLES_PER_BYTE. */
typedef struct {
    buffer_t bytes;
    size_t next;
    uint64_t ready_cycle; /* when the next byte has arrived whole */
} rx_line_t;

void rx_line_send(rx_line_t *line, const uint8_t *data, size_t n, uint64_t now_cycle);
static inline bool rx_line_idle(const rx_line_t *line) { return line->next == line->bytes.used; }
/* The byte that has arrived by `now_cycle`, if any. */
bool rx_line_take(rx_line_t *line, uint64_t now_cycle, uint8_t *byte);

/* Encoders that move evenly to where the parent wants them, by at most one count every CYCLES_PER_COUNT, unless the parent
 * wants more counts than the board can sample: those pass by unseen, as on a real board. */
typedef struct {
    int32_t count[AXES], start[AXES], target[AXES];
    uint32_t moves, move; /* in this slice: all there are, and done */
    uint64_t next_cycle;
    bool placed;
} encoders_t;

void encoders_aim(encoders_t *encoders, const int32_t target[AXES], uint64_t now_cycle, uint64_t until_cycle);
/* Moves on to `now_cycle`; true when a line may have changed. */
bool encoders_run(encoders_t *encoders, uint64_t now_cycle);
/* A and B of axis 0 in bits 0 and 1, and so on. */
uint8_t encoders_lines(const encoders_t *encoders);

/* What the current slice has produced. */
typedef struct {
    buffer_t uart, uart_cycles, edges;
} produce_t;

void produce_byte(produce_t *produce, uint64_t cycle, uint8_t byte);
void produce_edge(produce_t *produce, uint64_t cycle, unsigned axis, bool backwards);

/* Keeps standard output for the replies: what libraries print goes to standard error. */
void lockstep_open(void);
/* Blocks for the next request; uart receives the bytes that come with it. False when the parent is gone. */
bool request_read(request_t *request, buffer_t *uart);
/* Sends the counts and all that was produced, and empties `produce`. False when the parent is gone. */
bool reply_write(reply_t *reply, produce_t *produce);

#endif

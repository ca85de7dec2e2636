/* Lock step between a simulated board (child process) and its world (parent): one request, one reply, over pipes. */
#include "lockstep.h"

#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define REQUEST_MAX_BYTES (1U << 20)

void buffer_add(buffer_t *buffer, const void *data, size_t n) {
    if (!n) return;
    if (buffer->used + n > buffer->room) {
        buffer->room = 2 * (buffer->used + n) + 256;
        buffer->data = realloc(buffer->data, buffer->room);
        if (!buffer->data) abort();
    }
    memcpy(buffer->data + buffer->used, data, n);
    buffer->used += n;
}

void rx_line_send(rx_line_t *line, const uint8_t *data, size_t n, uint64_t now_cycle) {
    if (!n) return;
    if (line->next == line->bytes.used) {
        line->next = line->bytes.used = 0;
        if (line->ready_cycle < now_cycle) line->ready_cycle = now_cycle;
        line->ready_cycle += CYCLES_PER_BYTE;
    }
    buffer_add(&line->bytes, data, n);
}

bool rx_line_take(rx_line_t *line, uint64_t now_cycle, uint8_t *byte) {
    if (line->next == line->bytes.used || line->ready_cycle > now_cycle) return false;
    *byte = line->bytes.data[line->next++];
    if (line->next < line->bytes.used) line->ready_cycle += CYCLES_PER_BYTE;
    return true;
}

void encoders_aim(encoders_t *encoders, const int32_t target[AXES], uint64_t now_cycle, uint64_t until_cycle) {
    if (!encoders->placed) memcpy(encoders->count, target, sizeof encoders->count);
    if (encoders->next_cycle < now_cycle) encoders->next_cycle = now_cycle + CYCLES_PER_COUNT;
    encoders->placed = true;
    memcpy(encoders->start, encoders->count, sizeof encoders->start);
    memcpy(encoders->target, target, sizeof encoders->target);
    encoders->move = 0;
    encoders->moves = 0;
    if (until_cycle >= encoders->next_cycle)
        encoders->moves = (uint32_t)((until_cycle - encoders->next_cycle) / CYCLES_PER_COUNT) + 1;
}

static void encoders_move(encoders_t *encoders) {
    if (encoders->move < encoders->moves) encoders->move++;
    for (unsigned axis = 0; axis < AXES; axis++) {
        int64_t way = (int64_t)encoders->target[axis] - encoders->start[axis];
        int64_t due = encoders->moves ? encoders->start[axis] + way * encoders->move / encoders->moves
                                      : encoders->target[axis];
        /* A rotor that turns faster than the board samples: the lines change by more than one count between two samples. */
        int64_t seen = (int64_t)encoders->moves * CYCLES_PER_COUNT / CYCLES_PER_TICK + COUNTS_OF_JITTER;
        if (encoders->moves && (way > seen || -way > seen))
            encoders->count[axis] = (int32_t)due;
        else if (encoders->count[axis] < due)
            encoders->count[axis]++;
        else if (encoders->count[axis] > due)
            encoders->count[axis]--;
    }
}

bool encoders_run(encoders_t *encoders, uint64_t now_cycle) {
    bool moved = false;
    while (encoders->next_cycle <= now_cycle) {
        encoders_move(encoders);
        encoders->next_cycle += CYCLES_PER_COUNT;
        moved = true;
    }
    return moved;
}

uint8_t encoders_lines(const encoders_t *encoders) {
    static const uint8_t AB[4] = {0, 1, 3, 2};
    uint8_t lines = 0;
    for (unsigned axis = 0; axis < AXES; axis++)
        lines |= (uint8_t)(AB[(uint32_t)encoders->count[axis] & 3U] << (2 * axis));
    return lines;
}

void produce_byte(produce_t *produce, uint64_t cycle, uint8_t byte) {
    buffer_add(&produce->uart, &byte, 1);
    buffer_add(&produce->uart_cycles, &cycle, sizeof cycle);
}

void produce_edge(produce_t *produce, uint64_t cycle, unsigned axis, bool backwards) {
    edge_t edge = {cycle, (uint8_t)axis, backwards ? -1 : 1};
    buffer_add(&produce->edges, &edge, sizeof edge);
}

static int reply_file = STDOUT_FILENO;

void lockstep_open(void) {
    reply_file = dup(STDOUT_FILENO);
    dup2(STDERR_FILENO, STDOUT_FILENO);
}

static bool read_all(void *data, size_t n) {
    for (size_t done = 0; done < n;) {
        ssize_t got = read(STDIN_FILENO, (uint8_t *)data + done, n - done);
        if (got <= 0) return false;
        done += (size_t)got;
    }
    return true;
}

static bool write_all(const void *data, size_t n) {
    for (size_t done = 0; done < n;) {
        ssize_t put = write(reply_file, (const uint8_t *)data + done, n - done);
        if (put <= 0) return false;
        done += (size_t)put;
    }
    return true;
}

bool request_read(request_t *request, buffer_t *uart) {
    if (!read_all(request, sizeof *request) || request->uart_bytes > REQUEST_MAX_BYTES) return false;
    static uint8_t chunk[4096];
    uart->used = 0;
    for (uint32_t left = request->uart_bytes; left;) {
        uint32_t n = left < sizeof chunk ? left : sizeof chunk;
        if (!read_all(chunk, n)) return false;
        buffer_add(uart, chunk, n);
        left -= n;
    }
    return true;
}

bool reply_write(reply_t *reply, produce_t *produce) {
    static buffer_t out;
    reply->uart_bytes = (uint32_t)produce->uart.used;
    reply->edges = (uint32_t)(produce->edges.used / sizeof(edge_t));
    out.used = 0;
    buffer_add(&out, reply, sizeof *reply);
    buffer_add(&out, produce->uart.data, produce->uart.used);
    buffer_add(&out, produce->uart_cycles.data, produce->uart_cycles.used);
    buffer_add(&out, produce->edges.data, produce->edges.used);
    produce->uart.used = produce->uart_cycles.used = produce->edges.used = 0;
    return write_all(out.data, out.used);
}

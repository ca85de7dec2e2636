/* The native board as a library: the same requests and replies by a call, for a process that forks with its board. */
#define main native_board_main
#include "native_board.c"
#undef main

/* request: a request_t and its bytes. Returns the length of the reply (as reply_write sends it), which stays where
 * *answer points until the next call. */
size_t native_call(const uint8_t *asked, const uint8_t **answer) {
    static buffer_t uart, out;
    static produce_t produce;
    request_t request;
    memcpy(&request, asked, sizeof request);
    uart.used = out.used = 0;
    buffer_add(&uart, asked + sizeof request, request.uart_bytes);
    serve(&request, &uart, &produce);
    reply_t reply = counts();
    reply.uart_bytes = (uint32_t)produce.uart.used;
    reply.edges = (uint32_t)(produce.edges.used / sizeof(edge_t));
    buffer_add(&out, &reply, sizeof reply);
    buffer_add(&out, produce.uart.data, produce.uart.used);
    buffer_add(&out, produce.uart_cycles.data, produce.uart_cycles.used);
    buffer_add(&out, produce.edges.data, produce.edges.used);
    produce.uart.used = produce.uart_cycles.used = produce.edges.used = 0;
    *answer = out.data;
    return out.used;
}

/* The serial link: bytes in from the receiver, whole frames to the commands, frames out to the transmitter. */
#include "link.h"

#include "commands.h"
#include "frame_codec.h"
#include "port.h"

serial_t serial;

static frame_parser_t parser;
static uint8_t outgoing[FRAME_MAX_WIRE_BYTES];
static frame_writer_t writer;
static bool writing;   /* the frame in `outgoing` is not yet all in the ring */
static uint8_t pushed; /* bytes of it that are: it leaves while the rest is made */
static uint8_t outgoing_sequence;

/* Commands and set-points come from two writers, so each kind has its own count. */
enum { STREAM_COMMANDS, STREAM_SETPOINTS, STREAMS };
static struct {
    bool known;
    uint8_t last;
} sequence[STREAMS];

void link_start(void) {
    serial = (serial_t){0};
    parser = (frame_parser_t){0};
    outgoing_sequence = 0;
    writing = false;
    sequence[STREAM_COMMANDS].known = sequence[STREAM_SETPOINTS].known = false;
}

void link_restart_sequence(uint8_t number) {
    sequence[STREAM_COMMANDS].known = true;
    sequence[STREAM_COMMANDS].last = number;
    link_restart_setpoints();
}

void link_restart_setpoints(void) { sequence[STREAM_SETPOINTS].known = false; }

/* False for a frame seen before or overtaken by a later one. */
static bool in_order(uint8_t stream, uint8_t number) {
    uint8_t step = sequence[stream].known ? (uint8_t)(number - sequence[stream].last) : 1;
    if (step == 0 || step > 127) {
        serial.sequence_errors++;
        return false;
    }
    serial.sequence_errors += (uint8_t)(step - 1);
    sequence[stream].known = true;
    sequence[stream].last = number;
    return true;
}

static void dispatch(void) {
    uint8_t id = parser.body[0], number = parser.body[1];
    uint8_t payload_bytes = (uint8_t)(parser.length - FRAME_OVERHEAD_BYTES);
    if (!command_fits(id, payload_bytes)) {
        serial.crc_errors++;
        return;
    }
    uint8_t stream = id == FRAME_SETPOINT ? STREAM_SETPOINTS : STREAM_COMMANDS;
    if (id == FRAME_HELLO || in_order(stream, number)) command_take(id, number, parser.body + 2);
}

void link_poll(void) {
    for (uint8_t n; (n = ring_used(&serial.received)) != 0;) {
        uint8_t tail = serial.received.tail, until_wrap = (uint8_t)(0 - tail);
        if (until_wrap && n > until_wrap) n = until_wrap;
        parse_t result = frame_parse(&parser, serial.received.bytes + tail, &n);
        serial.received.tail = (uint8_t)(tail + n);
        if (result == PARSE_DAMAGED) serial.crc_errors++;
        if (result == PARSE_FRAME) dispatch();
    }
}

bool link_pump(uint8_t budget) {
    if (!writing) return false;
    bool done;
    uint8_t n = frame_work(&writer, budget, &done), head = serial.sending.head;
    while (pushed != n) serial.sending.bytes[head++] = outgoing[pushed++];
    serial.sending.head = head;
    port_start_transmitter();
    writing = !done;
    return writing;
}

uint8_t *link_payload(void) { return outgoing + 3; }

bool link_send(uint8_t id, uint8_t payload_bytes) {
    if (ring_room(&serial.sending) < payload_bytes + FRAME_OVERHEAD_BYTES + 2) return false;
    frame_begin(&writer, outgoing, id, outgoing_sequence++, payload_bytes);
    writing = true;
    pushed = 0;
    return true;
}

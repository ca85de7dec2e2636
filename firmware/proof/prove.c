/* What `make proof` proves, for all values at once, by abstract interpretation (Frama-C's plug-in Eva, which is sound).
 *
 * Each function below starts the core in any state within the invariants of any_state.h, lets one thing happen to it
 * with any argument, and checks that the invariants hold again. Eva checks every operation on the way: no signed
 * overflow, no division by zero, no shift beyond a type's width, no access outside an array, nothing read before it is
 * written. The Makefile runs it with int of 16 bits, as on the AVR, and of 32, as on this machine.
 *
 * Assumed, not proved: positions stay within FARTHEST (a sum over time; the fuzzer checks it), and interrupts leave the
 * core as one of these states.
 */
#include "any_state.h"

/* The invariants that the gate and the commands keep. */
static void check_gate(void) {
    for (int i = 0; i < AXIS_COUNT; i++) {
        //@ assert soft_limits_within_travel: -TRAVEL_MAX <= gate.axis[i].soft_min <= TRAVEL_MAX;
        //@ assert soft_limits_within_travel: -TRAVEL_MAX <= gate.axis[i].soft_max <= TRAVEL_MAX;
        //@ assert plan_within_travel: -PLANNED_FARTHEST <= gate.planned[i] <= PLANNED_FARTHEST;
        //@ assert speed_account_in_range: gate.ahead_q16[i] <= AHEAD_MOST;
        //@ assert speed_in_range: -32767 <= gate.speed_q15[i] <= 32767;
    }
}

static void check_state(void) {
    check_gate();
    //@ assert state_is_one: STATE_DISARMED <= safety.state <= STATE_FAULT;
    //@ assert fault_is_one: FAULT_NONE <= safety.fault <= FAULT_BROWNOUT;
    //@ assert head_in_queue: motion.head < QUEUE_SLOTS;
    //@ assert tail_in_queue: motion.tail < QUEUE_SLOTS;
    //@ assert mode_is_one: motion.mode <= MOTION_RAMP;
}

/* Any set-point in any state. */
void prove_setpoint(void) {
    frame_setpoint_t setpoint;
    any_state();
    ANY(setpoint);
    gate_take(&setpoint);
    check_state();
}

/* Any command frame in any state. */
void prove_commands(void) {
    uint8_t payload[FRAME_MAX_RX_BODY_BYTES], id, number;
    any_state();
    ANY(payload);
    ANY(id);
    ANY(number);
    command_take(id, number, payload);
    check_state();
    for (int i = 0; i < AXIS_COUNT; i++) {
        //@ assert named_within_travel: -FARTHEST <= motion.axis[i].position <= FARTHEST;
    }
}

/* Any byte on the line, in any state of the parser: more bytes are the same again. */
void prove_parser(void) {
    uint8_t byte, taken = 1;
    any_link();
    ANY(byte);
    frame_parse(&parser, &byte, &taken);
    //@ assert body_in_room: parser.length <= FRAME_MAX_RX_BODY_BYTES + 1;
    //@ assert took_at_most_one: taken <= 1;
}

/* Any frame that the board sends, with any payload, is made within its buffer. */
void prove_writer(void) {
    static const uint8_t PAYLOADS[] = {FRAME_IDENTITY_BYTES, FRAME_ACK_BYTES, FRAME_STATUS_BYTES};
    for (int i = 0; i < 3; i++) {
        bool done = false;
        uint8_t id, number;
        ANY(outgoing);
        ANY(id);
        ANY(number);
        frame_begin(&writer, outgoing, id, number, PAYLOADS[i]);
        for (int turn = 0; turn < 6; turn++) {
            uint8_t ready = frame_work(&writer, PORTION_BYTES, &done);
            //@ assert within_the_buffer: ready <= FRAME_MAX_WIRE_BYTES;
            if (done) break;
        }
        //@ assert finished: done;
    }
}

/* What the board says of itself, in any state. */
void prove_status(void) {
    any_state();
    send_status();
    check_state();
}

/* One step of the timer's interrupt in any state, with any inputs. */
void prove_tick(void) {
    uint8_t encoder_bits;
    any_state();
    ANY(encoder_bits);
    controller_tick(encoder_bits);
    check_state();
}

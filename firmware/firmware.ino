/* Stepper board of seldinger as an Arduino sketch; everything is in src/. Board: Arduino Mega 2560, Uno or Nano. */
#include "src/avr_main.h"

void setup() { firmware_setup(); }

void loop() { firmware_loop(); }

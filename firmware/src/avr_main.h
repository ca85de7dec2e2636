/* The two functions that an Arduino sketch calls. */
#ifndef AVR_MAIN_H
#define AVR_MAIN_H

#ifdef __cplusplus
extern "C" {
#endif

void firmware_setup(void);
void firmware_loop(void);

#ifdef __cplusplus
}
#endif

#endif

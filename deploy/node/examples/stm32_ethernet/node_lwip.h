/* A node behind Ethernet: the library below lwIP's raw API. */
#ifndef NODE_LWIP_H
#define NODE_LWIP_H

#include "rtloop_node.h"

/* Start a node at a UDP port; return false if the configuration is not allowed, or lwIP has no memory. */
bool node_lwip_start(const struct rtloop_node_config *config, uint32_t boot, uint16_t port);

/* Run the watchdog and the ramps; call this in the main loop, beside lwIP's own function, at least once per millisecond. */
void node_lwip_poll(void);

/* Return a clock in µs that wraps at 32 bits; the board has it. */
uint32_t board_clock_us(void);

/* Return whether a converter has not answered; the node then parks, and answers no more. */
bool board_failed(void);

#endif

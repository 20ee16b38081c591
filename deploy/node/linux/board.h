/* A board below the program rtloop-node. To port the program, write a file like board_rig.c for your converters. */
#ifndef BOARD_H
#define BOARD_H

#include "rtloop_node.h"

/* Lines of --help that describe the board's own options. */
extern const char board_help[];

/* Take an option of the command line; return how many words it has (2 with its value), 0 if it is no option of the
 * board, and -1, after a message, if its value is not allowed. */
int board_option(const char *name, const char *value);

/* Open the board, and describe its channels; the program fills in the functions. Return false, after a message, if it fails. */
bool board_open(struct rtloop_node_config *config);

/* Convert all inputs now. */
void board_read(int32_t *codes, uint16_t *digital);

/* Set all outputs. */
void board_write(const int32_t *codes, uint16_t digital);

#endif

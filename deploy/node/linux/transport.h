/* Frames over UDP, or coded over a serial line. */
#ifndef TRANSPORT_H
#define TRANSPORT_H

#include <sys/socket.h>
#include <sys/types.h>

#include "rtloop_cobs.h"

enum { TRANSPORT_BYTES = 2048 };

struct transport {
    int file;
    int other_end;                /* of a pseudo-terminal, held open so that a program that closes it ends nothing */
    const char *link;             /* to a pseudo-terminal */
    bool serial;
    bool lost;                    /* the serial device is gone */
    bool cut;                     /* the latest frame went out in part */
    uint32_t unsent;              /* answers that could not be sent at once */
    uint16_t port;
    size_t place;                 /* next byte of the line */
    size_t count;                 /* bytes of the line */
    uint8_t line[TRANSPORT_BYTES];
    struct rtloop_cobs receiver;
    struct sockaddr_storage peer;
    socklen_t peer_length;
};

/* Receive at a UDP port of an address, or of all with NULL; port 0: a free one. False, after a message, if that fails. */
bool transport_open_udp(struct transport *transport, const char *address, uint16_t port);

/* Use a serial device in raw mode; its speed stays. Return false, after a message, if that fails. */
bool transport_open_tty(struct transport *transport, const char *path);

/* Make a pseudo-terminal, and a symbolic link to it. Return false, after a message, if that fails. */
bool transport_open_pty(struct transport *transport, const char *link);

/* Take the next frame without waiting, with a number for its sender; return its length, -1 if there is none. */
ssize_t transport_receive(struct transport *transport, uint8_t frame[TRANSPORT_BYTES], uint64_t *sender);

/* Send an answer to the sender of the latest frame, without waiting. */
void transport_send(struct transport *transport, const uint8_t *answer, size_t length);

/* Close the transport, and remove its link. */
void transport_close(struct transport *transport);

#endif

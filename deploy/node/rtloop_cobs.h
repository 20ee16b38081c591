/* Frames on a serial line: consistent overhead byte stuffing (Cheshire and Baker 1999), and a byte 0 after each frame. */
#ifndef RTLOOP_COBS_H
#define RTLOOP_COBS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "rtloop_frame.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Largest number of bytes that a frame of `length` bytes needs on the line, with the byte 0. */
#define RTLOOP_COBS_SIZE(length) ((length) + (length) / 254 + 2)

/* A receiver that is fed byte by byte; all zero at the beginning. */
struct rtloop_cobs {
    uint32_t damaged;      /* frames that were cut, or longer than any DRIVE */
    uint16_t length;       /* bytes of the frame so far */
    uint8_t left;          /* bytes until the next code byte */
    bool zero;             /* a 0 belongs before the next block */
    bool too_long;
    bool complete;         /* the byte before this one ended a frame */
    uint8_t frame[RTLOOP_MAX_DRIVE];
};

/* Code a frame for the line, with its byte 0, into RTLOOP_COBS_SIZE(length) bytes, and return the number of bytes. */
size_t rtloop_cobs_encode(const uint8_t *frame, size_t length, uint8_t *line);

/* Take one byte from the line, and return the length of the frame that it ends, or 0.
 * The frame is in `frame` of the receiver until the next byte. */
size_t rtloop_cobs_receive(struct rtloop_cobs *receiver, uint8_t byte);

#ifdef __cplusplus
}
#endif

#endif

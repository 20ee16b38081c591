/* Frames between loop and node, protocol version 2 (docs/node-protocol.md): numbers in little-endian order, header, tag, check.
 *
 * Every function works on bytes, so that neither the processor's byte order nor an address of a frame matters. */
#ifndef RTLOOP_FRAME_H
#define RTLOOP_FRAME_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "rtloop_siphash.h"

enum {
    RTLOOP_PROTOCOL_VERSION = 2,
    RTLOOP_MAGIC = 0x057B,
    RTLOOP_MAX_CHANNELS = 44,                            /* inputs and outputs together */
    RTLOOP_MAX_DIGITAL = 16,
    RTLOOP_MAX_ANSWER = 52 + 32 * RTLOOP_MAX_CHANNELS,   /* bytes of the longest WELCOME */
    RTLOOP_MAX_DRIVE = 36 + 4 * 255,                     /* bytes of the longest DRIVE, of whatever node */
    RTLOOP_END_BYTES = 12                                /* tag and check */
};

enum rtloop_format { RTLOOP_HELLO = 0x70, RTLOOP_WELCOME, RTLOOP_DRIVE, RTLOOP_SAMPLE, RTLOOP_REFUSAL };

enum rtloop_drive_flag { RTLOOP_OPEN = 1, RTLOOP_APPLY = 2, RTLOOP_ANSWER = 4, RTLOOP_PARK = 8 };

enum rtloop_sample_flag { RTLOOP_READY = 1, RTLOOP_AT_SAFE = 2 };

enum rtloop_welcome_flag { RTLOOP_DRIVEN = 1, RTLOOP_KEYED = 2 };

enum rtloop_reason {
    RTLOOP_VERSION = 1,
    RTLOOP_BUSY,
    RTLOOP_UNKNOWN,
    RTLOOP_WATCHDOG,
    RTLOOP_SIZE,
    RTLOOP_RANGE,
    RTLOOP_FLAGS
};

/* Numbers that are in a frame's tag without being sent. */
struct rtloop_course {
    uint32_t boot;
    uint32_t opening;
    uint32_t turn;
};

/* Write a number of 16 bits to two bytes. */
static inline void rtloop_put16(uint8_t *bytes, uint32_t value)
{
    bytes[0] = (uint8_t)(value & 0xFFu);
    bytes[1] = (uint8_t)(value >> 8 & 0xFFu);
}

/* Write a number of 32 bits to four bytes. */
static inline void rtloop_put32(uint8_t *bytes, uint32_t value)
{
    rtloop_put16(bytes, value & 0xFFFFu);
    rtloop_put16(bytes + 2, value >> 16);
}

/* Write a number of 64 bits to eight bytes. */
static inline void rtloop_put64(uint8_t *bytes, uint64_t value)
{
    rtloop_put32(bytes, (uint32_t)(value & 0xFFFFFFFFu));
    rtloop_put32(bytes + 4, (uint32_t)(value >> 32));
}

/* Return the number of 16 bits in two bytes. */
static inline uint16_t rtloop_get16(const uint8_t *bytes)
{
    return (uint16_t)(bytes[0] | (uint32_t)bytes[1] << 8);
}

/* Return the number of 32 bits in four bytes. */
static inline uint32_t rtloop_get32(const uint8_t *bytes)
{
    return (uint32_t)rtloop_get16(bytes) | (uint32_t)rtloop_get16(bytes + 2) << 16;
}

/* Return the number of 64 bits in eight bytes. */
static inline uint64_t rtloop_get64(const uint8_t *bytes)
{
    return (uint64_t)rtloop_get32(bytes) | (uint64_t)rtloop_get32(bytes + 4) << 32;
}

/* Return the signed number of 32 bits in four bytes. */
static inline int32_t rtloop_get_code(const uint8_t *bytes)
{
    uint32_t value = rtloop_get32(bytes);
    return value <= INT32_MAX ? (int32_t)value : -(int32_t)(UINT32_MAX - value) - 1;
}

/* Return the CRC-32 (zlib's) of bytes, four bits at a time with a table of 64 bytes. */
static inline uint32_t rtloop_crc32(const uint8_t *bytes, size_t length)
{
    static const uint32_t table[16] = {
        0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u, 0x4DB26158u, 0x5005713Cu,
        0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu, 0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu,
    };
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0; i < length; i++) {
        crc ^= bytes[i];
        crc = crc >> 4 ^ table[crc & 15u];
        crc = crc >> 4 ^ table[crc & 15u];
    }
    return ~crc;
}

/* Write the header of a frame. */
static inline void rtloop_frame_begin(uint8_t *frame, enum rtloop_format format, uint32_t sequence)
{
    rtloop_put16(frame, RTLOOP_MAGIC);
    frame[2] = (uint8_t)format;
    frame[3] = 1;
    rtloop_put32(frame + 4, sequence);
}

/* Write the check to the last four of a frame's bytes, and return the frame's length. */
static inline size_t rtloop_frame_end(uint8_t *frame, size_t length)
{
    rtloop_put32(frame + length - 4, rtloop_crc32(frame, length - 4));
    return length;
}

/* Return the tag of a frame with this length; 0 without a key. */
static inline uint64_t rtloop_frame_tag(const uint8_t *frame, size_t length, const uint8_t *key, struct rtloop_course course)
{
    struct rtloop_siphash hash;
    uint8_t unsent[12];
    if (key == NULL) {
        return 0;
    }
    rtloop_put32(unsent, course.boot);
    rtloop_put32(unsent + 4, course.opening);
    rtloop_put32(unsent + 8, course.turn);
    rtloop_siphash_begin(&hash, key);
    rtloop_siphash_add(&hash, frame, length - RTLOOP_END_BYTES);
    rtloop_siphash_add(&hash, unsent, sizeof unsent);
    return rtloop_siphash_end(&hash);
}

/* Return whether a frame has the tag of a course, in a time that does not depend on the tag; true without a key. */
static inline bool rtloop_frame_tagged(const uint8_t *frame, size_t length, const uint8_t *key, struct rtloop_course course)
{
    return key == NULL || (rtloop_get64(frame + length - RTLOOP_END_BYTES) ^ rtloop_frame_tag(frame, length, key, course)) == 0;
}

/* Write the tag and the check to the last bytes of a frame, and return the frame's length. */
static inline size_t rtloop_frame_seal(uint8_t *frame, size_t length, const uint8_t *key, struct rtloop_course course)
{
    rtloop_put64(frame + length - RTLOOP_END_BYTES, rtloop_frame_tag(frame, length, key, course));
    return rtloop_frame_end(frame, length);
}

/* Return whether a frame has a valid header and check; its length is judged by its reader, who knows the format. */
static inline bool rtloop_frame_valid(const uint8_t *frame, size_t length)
{
    return length >= 20 && rtloop_get16(frame) == RTLOOP_MAGIC && frame[3] == 1
           && rtloop_get32(frame + length - 4) == rtloop_crc32(frame, length - 4);
}

#endif

/* SipHash-2-4 (Aumasson and Bernstein 2012): 64 bits of a message that nobody computes without the key.
 *
 * Bytes are taken one by one, so that neither the processor's byte order nor an address of a message matters. No branch and
 * no index depends on the key. */
#ifndef RTLOOP_SIPHASH_H
#define RTLOOP_SIPHASH_H

#include <stddef.h>
#include <stdint.h>

enum { RTLOOP_KEY_BYTES = 16 };

/* A message in work. */
struct rtloop_siphash {
    uint64_t v[4];
    uint64_t word;                /* the latest eight bytes, the newest one on top */
    uint8_t length;               /* bytes so far, modulo 256 */
};

static inline uint64_t rtloop_siphash_rotated(uint64_t word, unsigned bits)
{
    return word << bits | word >> (64 - bits);
}

/* Do a number of SipRounds. */
static inline void rtloop_siphash_mix(struct rtloop_siphash *hash, int rounds)
{
    uint64_t a = hash->v[0], b = hash->v[1], c = hash->v[2], d = hash->v[3];
    while (rounds-- > 0) {
        a += b;
        c += d;
        b = rtloop_siphash_rotated(b, 13) ^ a;
        d = rtloop_siphash_rotated(d, 16) ^ c;
        a = rtloop_siphash_rotated(a, 32) + d;
        c += b;
        d = rtloop_siphash_rotated(d, 21) ^ a;
        b = rtloop_siphash_rotated(b, 17) ^ c;
        c = rtloop_siphash_rotated(c, 32);
    }
    hash->v[0] = a, hash->v[1] = b, hash->v[2] = c, hash->v[3] = d;
}

/* Append bytes to the message. */
static inline void rtloop_siphash_add(struct rtloop_siphash *hash, const uint8_t *bytes, size_t count)
{
    for (size_t i = 0; i < count; i++) {
        hash->word = hash->word >> 8 | (uint64_t)bytes[i] << 56;
        if (++hash->length % 8 == 0) {
            hash->v[3] ^= hash->word;
            rtloop_siphash_mix(hash, 2);
            hash->v[0] ^= hash->word;
        }
    }
}

/* Begin a message. */
static inline void rtloop_siphash_begin(struct rtloop_siphash *hash, const uint8_t key[RTLOOP_KEY_BYTES])
{
    uint64_t half[2] = {0, 0};
    for (int i = RTLOOP_KEY_BYTES; i-- > 0;) {
        half[i / 8] = half[i / 8] << 8 | key[i];
    }
    hash->v[0] = half[0] ^ 0x736F6D6570736575u;
    hash->v[1] = half[1] ^ 0x646F72616E646F6Du;
    hash->v[2] = half[0] ^ 0x6C7967656E657261u;
    hash->v[3] = half[1] ^ 0x7465646279746573u;
    hash->word = 0;
    hash->length = 0;
}

/* End the message, and return its 64 bits. */
static inline uint64_t rtloop_siphash_end(struct rtloop_siphash *hash)
{
    static const uint8_t nothing[8] = {0};
    const uint8_t length = hash->length;
    rtloop_siphash_add(hash, nothing, (size_t)(7 - length % 8));
    rtloop_siphash_add(hash, &length, 1);
    hash->v[2] ^= 0xFF;
    rtloop_siphash_mix(hash, 4);
    return hash->v[0] ^ hash->v[1] ^ hash->v[2] ^ hash->v[3];
}

#endif

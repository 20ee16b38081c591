/* A bad wire for one program: its frames are late, or are lost at random and logged.
 *
 * Preloaded into rtloop-node (LD_PRELOAD). WIRE_FILE names a file for the counts and losses, WIRE_LOSS is the share of
 * frames to lose, WIRE_SEED begins the random numbers, WIRE_DELAY_US delays each SAMPLE. Only DRIVEs with codes and the
 * SAMPLEs after the first of them are lost: opening and parking of a session are not disturbed. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { DRIVE = 0x72, SAMPLE = 0x73, FORMAT_AT = 2, SEQUENCE_AT = 4, BITS_AT = 12, APPLY = 2, ANSWER = 4 };
enum { MAX_LOST = 4096 };

/* Log that the test reads; `lost` holds the sequences of lost frames, DRIVEs and SAMPLEs together. */
static struct log {
    uint32_t first; /* sequence of the first DRIVE with codes */
    uint32_t losses;
    uint64_t drives;
    uint64_t samples;
    uint32_t lost[MAX_LOST];
} *shared_log;

static uint64_t limit;
static uint64_t state;
static int64_t delay_ns;

/* Map the log file and read the settings; abort the program if one is missing. */
__attribute__((constructor)) static void begin(void)
{
    const char *name = getenv("WIRE_FILE");
    const char *share = getenv("WIRE_LOSS");
    const char *seed = getenv("WIRE_SEED");
    const char *delay_us = getenv("WIRE_DELAY_US");
    int file = name == NULL ? -1 : open(name, O_RDWR | O_CREAT, 0600);
    if (file < 0 || share == NULL || seed == NULL || delay_us == NULL || ftruncate(file, sizeof *shared_log) != 0) {
        abort();
    }
    shared_log = mmap(NULL, sizeof *shared_log, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    if (shared_log == MAP_FAILED) {
        abort();
    }
    close(file);
    limit = (uint64_t)(strtod(share, NULL) * 0x1p64);
    delay_ns = (int64_t)(strtod(delay_us, NULL) * 1e3);
    state = strtoull(seed, NULL, 10) * 2 + 1;
}

/* Return whether to lose the next frame (xorshift64*, Vigna 2016). */
static int draw(void)
{
    state ^= state >> 12;
    state ^= state << 25;
    state ^= state >> 27;
    return state * 0x2545F4914F6CDD1Dull < limit;
}

/* Count a frame that is about to pass; return whether it is lost. */
static int lose(const uint8_t *frame, size_t length, uint8_t format, uint64_t *count)
{
    uint32_t sequence;
    if (length < BITS_AT + 1 || frame[FORMAT_AT] != format) {
        return 0;
    }
    memcpy(&sequence, frame + SEQUENCE_AT, sizeof sequence);
    if (format == DRIVE) {
        if (frame[BITS_AT] != (APPLY | ANSWER)) {
            return 0;
        }
        shared_log->first = shared_log->first == 0 ? sequence : shared_log->first;
    } else if (shared_log->first == 0 || sequence < shared_log->first) {
        return 0;
    }
    ++*count;
    if (!draw()) {
        return 0;
    }
    if (shared_log->losses == MAX_LOST) {
        abort();
    }
    shared_log->lost[shared_log->losses++] = sequence;
    return 1;
}

/* Return CLOCK_MONOTONIC in ns. */
static int64_t clock_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

/* Wait for the delay of a frame, without sleep. */
static void wait_on_the_way(void)
{
    for (int64_t end_ns = clock_ns() + delay_ns; clock_ns() < end_ns;) {
    }
}

ssize_t recvfrom(int file, void *data, size_t size, int flags, struct sockaddr *sender, socklen_t *sender_size)
{
    static ssize_t (*real)(int, void *, size_t, int, struct sockaddr *, socklen_t *);
    if (real == NULL) {
        real = dlsym(RTLD_NEXT, "recvfrom");
    }
    ssize_t length = real(file, data, size, flags, sender, sender_size);
    if (length > 0 && lose(data, (size_t)length, DRIVE, &shared_log->drives)) {
        errno = EAGAIN;
        return -1;
    }
    return length;
}

ssize_t sendto(int file, const void *data, size_t size, int flags, const struct sockaddr *to, socklen_t to_size)
{
    static ssize_t (*real)(int, const void *, size_t, int, const struct sockaddr *, socklen_t);
    if (real == NULL) {
        real = dlsym(RTLD_NEXT, "sendto");
    }
    if (lose(data, size, SAMPLE, &shared_log->samples)) {
        return (ssize_t)size;
    }
    wait_on_the_way();
    return real(file, data, size, flags, to, to_size);
}

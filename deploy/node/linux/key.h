/* The key of node and loop in a file. */
#ifndef KEY_H
#define KEY_H

#include <ctype.h>
#include <errno.h>
#include <fcntl.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "rtloop_siphash.h"

/* Read 32 hexadecimal digits, and white space behind them, to a key; return whether a text is that. */
static inline bool key_from_text(const char *text, uint8_t key[RTLOOP_KEY_BYTES])
{
    for (int i = 0; i < RTLOOP_KEY_BYTES; i++, text += 2) {
        char byte[3] = {text[0], text[0] != '\0' ? text[1] : '\0', '\0'};
        if (!isxdigit((unsigned char)byte[0]) || !isxdigit((unsigned char)byte[1])) {
            return false;
        }
        key[i] = (uint8_t)strtoul(byte, NULL, 16);
    }
    return text[strspn(text, " \t\r\n")] == '\0';
}

/* Read a key from a file that nobody but its owner, the caller or root, may read or write; return false, after a message, for any other. */
static inline bool key_read(const char *path, uint8_t key[RTLOOP_KEY_BYTES])
{
    char text[128] = {0};
    struct stat status;
    int file = open(path, O_RDONLY | O_NONBLOCK | O_CLOEXEC);
    if (file < 0 || fstat(file, &status) != 0) {
        fprintf(stderr, "--key: %s: %s\n", path, strerror(errno));
        return false;
    }
    ssize_t count = S_ISREG(status.st_mode) ? read(file, text, sizeof text - 1) : 0;
    close(file);
    if (status.st_uid != geteuid() && status.st_uid != 0) {
        fprintf(stderr, "--key: %s belongs to user %u; allowed: your own file or root's; chown it, then chmod 600\n", path,
                (unsigned)status.st_uid);
        return false;
    }
    if (status.st_mode & 077) {
        fprintf(stderr, "--key: %s has mode %03o; allowed: no right for group and others; run chmod 600 %s\n", path,
                (unsigned)status.st_mode & 0777, path);
        return false;
    }
    if (count < 0 || !key_from_text(text, key)) {
        fprintf(stderr, "--key: %s is no key; allowed: a file of 32 hexadecimal digits\n", path);
        return false;
    }
    return true;
}

#endif

#include "transport.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <termios.h>
#include <unistd.h>

/* Print what failed, and return false. */
static bool failed(const char *option, const char *value)
{
    fprintf(stderr, "%s: %s: %s\n", option, value, strerror(errno));
    return false;
}

/* Note the port that the system chose. */
static void note_port(struct transport *transport)
{
    struct sockaddr_storage own;
    socklen_t length = sizeof own;
    if (getsockname(transport->file, (struct sockaddr *)&own, &length) == 0) {
        in_port_t port = own.ss_family == AF_INET ? ((struct sockaddr_in *)&own)->sin_port : ((struct sockaddr_in6 *)&own)->sin6_port;
        transport->port = ntohs(port);
    }
}

/* Bind a socket of one family; IPv6's takes IPv4 as well if it is bound to no address. */
static bool bind_socket(struct transport *transport, const struct addrinfo *own)
{
    int off = 0;
    transport->file = socket(own->ai_family, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (transport->file < 0) {
        return false;
    }
    if (own->ai_family == AF_INET6) {
        setsockopt(transport->file, IPPROTO_IPV6, IPV6_V6ONLY, &off, sizeof off);
    }
    if (bind(transport->file, own->ai_addr, own->ai_addrlen) == 0) {
        note_port(transport);
        return true;
    }
    int reason = errno;
    close(transport->file);
    errno = reason;
    return false;
}

bool transport_open_udp(struct transport *transport, const char *address, uint16_t port)
{
    struct addrinfo hints = {.ai_socktype = SOCK_DGRAM, .ai_flags = AI_PASSIVE | AI_NUMERICHOST | AI_NUMERICSERV};
    struct addrinfo *own = NULL;
    char service[8];
    const char *families[] = {"::", "0.0.0.0"};
    snprintf(service, sizeof service, "%u", port);
    for (size_t i = 0; i < 2; i++) {
        if (getaddrinfo(address != NULL ? address : families[i], service, &hints, &own) != 0) {
            fprintf(stderr, "--bind: value is %s; allowed: a numeric IPv4 or IPv6 address\n", address);
            return false;
        }
        bool bound = bind_socket(transport, own);
        freeaddrinfo(own);
        if (bound || address != NULL) {
            return bound ? true : failed("--bind", address);
        }
    }
    return failed("--port", service);
}

/* Make a terminal pass bytes on as they are. */
static bool make_raw(int file)
{
    struct termios mode;
    if (tcgetattr(file, &mode) != 0) {
        return false;
    }
    cfmakeraw(&mode);
    return tcsetattr(file, TCSANOW, &mode) == 0;
}

bool transport_open_tty(struct transport *transport, const char *path)
{
    transport->serial = true;
    transport->file = open(path, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    return (transport->file >= 0 && make_raw(transport->file)) ? true : failed("--tty", path);
}

bool transport_open_pty(struct transport *transport, const char *link)
{
    struct stat present;
    transport->serial = true;
    transport->file = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (transport->file < 0 || grantpt(transport->file) != 0 || unlockpt(transport->file) != 0) {
        return failed("--pty", link);
    }
    const char *device = ptsname(transport->file);
    if (device == NULL || (transport->other_end = open(device, O_RDWR | O_NOCTTY | O_CLOEXEC)) < 0) {
        return failed("--pty", link);
    }
    if (lstat(link, &present) == 0 && S_ISLNK(present.st_mode)) {
        unlink(link); /* of a node that was killed */
    }
    if (!make_raw(transport->other_end) || symlink(device, link) != 0) {
        return failed("--pty", link);
    }
    transport->link = link;
    return true;
}

/* Return a number for an address and port: of IPv4 themselves, of IPv6 a hash of 64 bits (FNV-1a). */
static uint64_t sender_number(const struct sockaddr_storage *peer)
{
    if (peer->ss_family == AF_INET) {
        const struct sockaddr_in *v4 = (const struct sockaddr_in *)peer;
        return (uint64_t)ntohl(v4->sin_addr.s_addr) << 16 | ntohs(v4->sin_port);
    }
    const struct sockaddr_in6 *v6 = (const struct sockaddr_in6 *)peer;
    uint64_t hash = 14695981039346656037ull;
    for (size_t i = 0; i < 16; i++) {
        hash = (hash ^ v6->sin6_addr.s6_addr[i]) * 1099511628211ull;
    }
    hash = (hash ^ v6->sin6_scope_id) * 1099511628211ull;
    return (hash ^ v6->sin6_port) * 1099511628211ull;
}

/* Take the next frame from a serial line. */
static ssize_t receive_serial(struct transport *transport, uint8_t *frame)
{
    for (;;) {
        while (transport->place < transport->count) {
            size_t length = rtloop_cobs_receive(&transport->receiver, transport->line[transport->place++]);
            if (length != 0) {
                memcpy(frame, transport->receiver.frame, length);
                return (ssize_t)length;
            }
        }
        ssize_t count = read(transport->file, transport->line, sizeof transport->line);
        if (count <= 0) {
            transport->lost = count == 0 || (errno != EAGAIN && errno != EINTR);
            return -1;
        }
        transport->place = 0;
        transport->count = (size_t)count;
    }
}

ssize_t transport_receive(struct transport *transport, uint8_t frame[TRANSPORT_BYTES], uint64_t *sender)
{
    if (transport->serial) {
        *sender = 0;
        return receive_serial(transport, frame);
    }
    transport->peer_length = sizeof transport->peer;
    ssize_t length = recvfrom(transport->file, frame, TRANSPORT_BYTES, MSG_DONTWAIT, (struct sockaddr *)&transport->peer,
                              &transport->peer_length);
    if (length >= 0) {
        *sender = sender_number(&transport->peer);
    }
    return length;
}

/* Send a coded frame; one that went out in part is ended by a byte 0 before the next. */
static bool send_serial(struct transport *transport, const uint8_t *answer, size_t length)
{
    uint8_t line[1 + RTLOOP_COBS_SIZE(RTLOOP_MAX_ANSWER)] = {0};
    size_t size = 1 + rtloop_cobs_encode(answer, length, line + 1);
    size_t start = transport->cut ? 0 : 1;
    ssize_t sent = write(transport->file, line + start, size - start);
    if (sent > 0) {
        transport->cut = (size_t)sent != size - start;
    }
    return sent == (ssize_t)(size - start);
}

void transport_send(struct transport *transport, const uint8_t *answer, size_t length)
{
    bool sent;
    if (transport->serial) {
        sent = send_serial(transport, answer, length);
    } else {
        sent = sendto(transport->file, answer, length, MSG_DONTWAIT, (struct sockaddr *)&transport->peer,
                      transport->peer_length) == (ssize_t)length;
    }
    transport->unsent += !sent;
}

void transport_close(struct transport *transport)
{
    if (transport->link != NULL) {
        unlink(transport->link);
    }
    close(transport->file);
}

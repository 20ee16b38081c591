#include "rtloop_cobs.h"

size_t rtloop_cobs_encode(const uint8_t *frame, size_t length, uint8_t *line)
{
    size_t code = 0; /* place of the open block's code byte */
    size_t end = 1;
    for (size_t i = 0; i < length; i++) {
        if (frame[i] != 0) {
            line[end++] = frame[i];
        }
        if (frame[i] == 0 || (end - code == 255 && i + 1 < length)) {
            line[code] = (uint8_t)(end - code);
            code = end++;
        }
    }
    line[code] = (uint8_t)(end - code);
    line[end++] = 0;
    return end;
}

/* Append one byte to the frame of a receiver; beyond the longest DRIVE the frame is marked and the byte dropped. */
static void append(struct rtloop_cobs *receiver, uint8_t byte)
{
    if (receiver->length < sizeof receiver->frame) {
        receiver->frame[receiver->length++] = byte;
    } else {
        receiver->too_long = true;
    }
}

/* End the frame of a receiver, and return its length; 0 if it is damaged or empty. */
static size_t end_frame(struct rtloop_cobs *receiver)
{
    bool damaged = receiver->left != 0 || receiver->too_long;
    size_t length = damaged ? 0 : receiver->length;
    receiver->damaged += damaged;
    receiver->left = 0;
    receiver->zero = false;
    receiver->too_long = false;
    receiver->complete = true;
    return length;
}

size_t rtloop_cobs_receive(struct rtloop_cobs *receiver, uint8_t byte)
{
    if (receiver->complete) {
        receiver->length = 0;
        receiver->complete = false;
    }
    if (byte == 0) {
        return end_frame(receiver);
    }
    if (receiver->left != 0) {
        append(receiver, byte);
        receiver->left--;
        return 0;
    }
    if (receiver->zero) {
        append(receiver, 0);
    }
    receiver->left = (uint8_t)(byte - 1);
    receiver->zero = byte != 255;
    return 0;
}

/* lwIP without an operating system calls `receive` from the main loop: no call of the node interrupts another one. */
#include "node_lwip.h"

#include "lwip/pbuf.h"
#include "lwip/udp.h"

static struct rtloop_node node;
static uint64_t now_us;

/* Send an answer in a buffer of lwIP; one that finds no memory is lost, as on a network. */
static void send_answer(struct udp_pcb *socket, const uint8_t *answer, size_t length, const ip_addr_t *address, u16_t port)
{
    struct pbuf *buffer = pbuf_alloc(PBUF_TRANSPORT, (u16_t)length, PBUF_RAM);
    if (buffer != NULL) {
        pbuf_take(buffer, answer, (u16_t)length);
        udp_sendto(socket, buffer, address, port);
        pbuf_free(buffer);
    }
}

/* Process one datagram. */
static void receive(void *argument, struct udp_pcb *socket, struct pbuf *datagram, const ip_addr_t *address, u16_t port)
{
    static uint8_t frame[RTLOOP_MAX_DRIVE];
    static uint8_t answer[RTLOOP_NODE_MAX_ANSWER];
    (void)argument;
    /* A datagram longer than any DRIVE arrives as an empty frame: the node counts it as invalid. */
    size_t length = datagram->tot_len <= sizeof frame ? pbuf_copy_partial(datagram, frame, datagram->tot_len, 0) : 0;
    uint64_t sender = (uint64_t)ip4_addr_get_u32(ip_2_ip4(address)) << 16 | port;
    now_us = rtloop_node_extend_us(now_us, board_clock_us());
    size_t answered = rtloop_node_receive(&node, frame, length, sender, now_us, answer);
    if (board_failed()) {
        rtloop_node_park(&node, now_us);
    } else if (answered != 0) {
        send_answer(socket, answer, answered, address, port);
    }
    pbuf_free(datagram);
}

bool node_lwip_start(const struct rtloop_node_config *config, uint32_t boot, uint16_t port)
{
    now_us = board_clock_us();
    if (!rtloop_node_init(&node, config, boot, now_us)) {
        return false;
    }
    struct udp_pcb *socket = udp_new();
    if (socket == NULL || udp_bind(socket, IP4_ADDR_ANY, port) != ERR_OK) {
        return false;
    }
    udp_recv(socket, receive, NULL);
    return true;
}

void node_lwip_poll(void)
{
    now_us = rtloop_node_extend_us(now_us, board_clock_us());
    rtloop_node_poll(&node, now_us);
}

/* A NUCLEO-H743ZI with a DAC8563 on SPI3 and two ADS8681 on SPI1, in a project that STM32CubeMX made with them, LWIP and RNG.
 *
 * No board was met, and this file was compiled against stand-ins of the vendor's headers alone. main.c of the project calls
 * board_start() after the functions MX_…, and in its endless loop MX_LWIP_Process() and node_lwip_poll(). */
#include "main.h"

#include "node_lwip.h"

extern SPI_HandleTypeDef hspi1;
extern SPI_HandleTypeDef hspi3;
extern RNG_HandleTypeDef hrng;

enum { PORT = 5747 };

/* Chip selects, pins of port D: of the DAC, then of the ADCs. */
static const uint16_t selects[3] = {GPIO_PIN_14, GPIO_PIN_15, GPIO_PIN_0};

static const uint8_t key[RTLOOP_KEY_BYTES] = {
#include "node_key.inc" /* README.md says how to make it */
};

static bool failed;

bool board_failed(void)
{
    return failed;
}

uint32_t board_clock_us(void)
{
    /* The cycle counter wraps each 9 s at 480 MHz: the cycles since the last call are added up. */
    static uint32_t last_cycles, rest_cycles, time_us;
    uint32_t cycles = DWT->CYCCNT;
    uint32_t per_us = SystemCoreClock / 1000000u;
    rest_cycles += cycles - last_cycles;
    last_cycles = cycles;
    time_us += rest_cycles / per_us;
    rest_cycles %= per_us;
    return time_us;
}

/* Exchange up to four bytes with a chip, and return the first two that it sent. */
static uint16_t exchange(SPI_HandleTypeDef *bus, uint16_t select, const uint8_t *bytes, uint16_t count)
{
    uint8_t received[4] = {0};
    HAL_GPIO_WritePin(GPIOD, select, GPIO_PIN_RESET);
    if (HAL_SPI_TransmitReceive(bus, (uint8_t *)(uintptr_t)bytes, received, count, 1) != HAL_OK) {
        failed = true;
    }
    HAL_GPIO_WritePin(GPIOD, select, GPIO_PIN_SET);
    return (uint16_t)(received[0] << 8 | received[1]);
}

/* Send a command with an address, and a value, to the DAC. */
static void send_dac(uint8_t command, uint16_t value)
{
    const uint8_t bytes[3] = {command, (uint8_t)(value >> 8), (uint8_t)(value & 0xFFu)};
    exchange(&hspi3, selects[0], bytes, 3);
}

/* Convert all inputs: the end of one exchange starts a conversion, the next exchange reads it. */
static void board_read(void *context, int32_t *codes, uint16_t *digital)
{
    static const uint8_t nothing[4] = {0};
    (void)context;
    exchange(&hspi1, selects[1], nothing, 4);
    exchange(&hspi1, selects[2], nothing, 4); /* longer than the 665 ns that a conversion takes */
    codes[0] = exchange(&hspi1, selects[1], nothing, 4);
    codes[1] = exchange(&hspi1, selects[2], nothing, 4);
    *digital = 0;
}

/* Set both outputs at the same moment. */
static void board_write(void *context, const int32_t *codes, uint16_t digital)
{
    (void)context;
    (void)digital;
    send_dac(0x00, (uint16_t)codes[0]); /* write register A */
    send_dac(0x11, (uint16_t)codes[1]); /* write register B, update both */
}

void board_start(void)
{
    static const struct rtloop_node_channel input[2] = {
        {0, 65535, 0, 0, 20.48 / 65536.0, -10.24}, {0, 65535, 0, 0, 20.48 / 65536.0, -10.24}};
    static const struct rtloop_node_channel output[2] = {
        {0, 65535, 32768, 33, 20.0 / 65536.0, -10.0}, {0, 65535, 32768, 33, 20.0 / 65536.0, -10.0}};
    static const struct rtloop_node_config config = {
        .inputs = 2, .outputs = 2, .longest_hold_us = 100000, .shortest_period_us = 100, .input = input, .output = output, .key = key,
        .read_inputs = board_read, .write_outputs = board_write};
    static const uint8_t range[4] = {0xD0, 0x14, 0x00, 0x01}; /* of the ADCs: -10.24 V to 10.24 V */
    uint32_t boot = 0;
    CoreDebug->DEMCR |= CoreDebug_DEMCR_TRCENA_Msk;
    DWT->CTRL |= DWT_CTRL_CYCCNTENA_Msk;
    send_dac(0x38, 1); /* the DAC's own reference, gain 2 */
    exchange(&hspi1, selects[1], range, 4);
    exchange(&hspi1, selects[2], range, 4);
    if (HAL_RNG_GenerateRandomNumber(&hrng, &boot) != HAL_OK || failed || !node_lwip_start(&config, boot, PORT)) {
        Error_Handler();
    }
}

// A node on a Teensy 4.1 behind USB: DAC8563 (two outputs) and two ADS8681 (one input each) on one SPI bus.
//
// No board was met: this file was compiled against stand-ins of Arduino's headers alone. README.md beside it says how to wire.
#include <Entropy.h>
#include <SPI.h>

#include "rtloop_cobs.h"
#include "rtloop_node.h"

static const uint8_t DAC_SELECT = 10;
static const uint8_t ADC_SELECT[2] = {8, 9};
static const SPISettings DAC_BUS(20000000, MSBFIRST, SPI_MODE1);
static const SPISettings ADC_BUS(20000000, MSBFIRST, SPI_MODE0);

// Codes as the chips have them: 0 to 65535. The output stage turns the DAC's 0 V to 5 V into -10 V to 10 V.
static const struct rtloop_node_channel inputs[2] = {
    {0, 65535, 0, 0, 20.48 / 65536.0, -10.24},
    {0, 65535, 0, 0, 20.48 / 65536.0, -10.24},
};
static const struct rtloop_node_channel outputs[2] = {
    {0, 65535, 32768, 33, 20.0 / 65536.0, -10.0},  // safe: 0 V; ramps: 33 codes, 10 mV, in 1 ms
    {0, 65535, 32768, 33, 20.0 / 65536.0, -10.0},
};

static const uint8_t key[RTLOOP_KEY_BYTES] = {
#include "node_key.inc"  // README.md says how to make it
};

static struct rtloop_node node;
static struct rtloop_cobs line;
static uint64_t now_us;

// Send 24 bits to the DAC: a command with an address, and a value.
static void send_dac(uint8_t command, uint16_t value)
{
    SPI.beginTransaction(DAC_BUS);
    digitalWriteFast(DAC_SELECT, LOW);
    SPI.transfer(command);
    SPI.transfer16(value);
    digitalWriteFast(DAC_SELECT, HIGH);
    SPI.endTransaction();
}

// Exchange 32 bits with an ADC, and return the upper 16, its latest code. The rising edge of its select starts a conversion.
static uint16_t exchange_adc(uint8_t select, uint16_t command, uint16_t value)
{
    SPI.beginTransaction(ADC_BUS);
    digitalWriteFast(select, LOW);
    uint16_t code = SPI.transfer16(command);
    SPI.transfer16(value);
    digitalWriteFast(select, HIGH);
    SPI.endTransaction();
    return code;
}

// Make a pin the select of a chip that is not selected.
static void prepare_select(uint8_t pin)
{
    pinMode(pin, OUTPUT);
    digitalWriteFast(pin, HIGH);
}

// Convert all inputs: the first exchange starts the conversions, the second one reads them.
static void board_read(void *, int32_t *codes, uint16_t *digital)
{
    for (uint8_t select : ADC_SELECT) {
        exchange_adc(select, 0, 0);
    }
    delayNanoseconds(700);  // ADS8681: a conversion takes up to 665 ns
    for (int i = 0; i < 2; i++) {
        codes[i] = exchange_adc(ADC_SELECT[i], 0, 0);
    }
    *digital = 0;
}

// Set both outputs at the same moment.
static void board_write(void *, const int32_t *codes, uint16_t)
{
    send_dac(0x00, (uint16_t)codes[0]);  // write register A
    send_dac(0x11, (uint16_t)codes[1]);  // write register B, update both
}

static struct rtloop_node_config config;

void setup()
{
    config.inputs = 2;
    config.outputs = 2;
    config.longest_hold_us = 100000;
    config.shortest_period_us = 100;
    config.input = inputs;
    config.output = outputs;
    config.key = key;
    config.read_inputs = board_read;
    config.write_outputs = board_write;
    prepare_select(DAC_SELECT);
    for (uint8_t select : ADC_SELECT) {
        prepare_select(select);
    }
    SPI.begin();
    send_dac(0x38, 1);  // the DAC's own reference, gain 2
    for (uint8_t select : ADC_SELECT) {
        exchange_adc(select, 0xD014, 0x0001);  // range: -10.24 V to 10.24 V
    }
    Serial.begin(0);  // USB: the speed has no meaning
    Entropy.Initialize();
    now_us = micros();
    if (!rtloop_node_init(&node, &config, Entropy.random(), now_us)) {
        for (;;) {
        }
    }
}

void loop()
{
    static uint8_t answer[RTLOOP_NODE_MAX_ANSWER];
    static uint8_t coded[RTLOOP_COBS_SIZE(RTLOOP_NODE_MAX_ANSWER)];
    now_us = rtloop_node_extend_us(now_us, micros());
    rtloop_node_poll(&node, now_us);
    for (int rest = Serial.available(); rest > 0; rest--) {
        size_t length = rtloop_cobs_receive(&line, (uint8_t)Serial.read());
        size_t answered = length != 0 ? rtloop_node_receive(&node, line.frame, length, 0, now_us, answer) : 0;
        size_t size = answered != 0 ? rtloop_cobs_encode(answer, answered, coded) : 0;
        if (size != 0 && Serial.availableForWrite() >= (int)size) {
            Serial.write(coded, size);
            Serial.send_now();
        }
    }
}

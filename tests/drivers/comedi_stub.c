/* A stand-in for libcomedi and a board: a file whose outputs are looped back to its inputs.
 *
 * The file is the hardware: it outlives every process, and a test can read it. Subdevice 0 has eight inputs of 16 bit
 * with the ranges ±10, ±5 and 0 … 5 V, subdevice 1 four outputs of 16 bit with ±10 and 0 … 5 V, subdevice 2 is digital.
 * Input i reads output i; inputs without an output read 0 V. Outputs can be read back unless the board is mute.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

enum { INPUTS = 8, OUTPUTS = 4, MAXDATA = 65535, AI = 1, AO = 2, DIO = 5 };

typedef struct { double min, max; unsigned unit; } range;
typedef struct { uint32_t magic, fail_read, fail_write, code[OUTPUTS], range[OUTPUTS], mute; } hardware;
typedef struct { int fd; hardware *board; } comedi_t;

static range input_ranges[] = {{-10, 10, 0}, {-5, 5, 0}, {0, 5, 0}, {0, 20, 1}};
static range output_ranges[] = {{-10, 10, 0}, {0, 5, 0}};
static const int types[] = {AI, AO, DIO}, channels[] = {INPUTS, OUTPUTS, 24}, ranges[] = {4, 2, 1};
static int last_errno;

static int failed(int reason) { last_errno = reason; return -1; }

int comedi_errno(void) { return last_errno; }
char *comedi_strerror(int number) { return strerror(number); }

comedi_t *comedi_open(const char *name)
{
    struct stat status;
    int fd = open(name, O_RDWR | O_CLOEXEC);
    if (fd < 0) { failed(errno); return NULL; }
    if (fstat(fd, &status) < 0 || status.st_size < (off_t)sizeof(hardware)) { close(fd); failed(ENOTTY); return NULL; }
    comedi_t *it = malloc(sizeof *it);
    it->fd = fd;
    it->board = mmap(NULL, sizeof(hardware), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    if (it->board->magic != 0xda9) { munmap(it->board, sizeof(hardware)); close(fd); free(it); failed(ENOTTY); return NULL; }
    return it;
}

int comedi_close(comedi_t *it)
{
    munmap(it->board, sizeof(hardware));
    close(it->fd);
    free(it);
    return 0;
}

int comedi_get_n_subdevices(comedi_t *it) { return 3; }
int comedi_get_subdevice_type(comedi_t *it, unsigned subdevice)
{
    return subdevice < 3 ? types[subdevice] : failed(EINVAL);
}
int comedi_find_subdevice_by_type(comedi_t *it, int type, unsigned start)
{
    for (unsigned i = start; i < 3; i++)
        if (types[i] == type) return i;
    return -1;
}
int comedi_lock(comedi_t *it, unsigned subdevice)
{
    struct flock request = {.l_type = F_WRLCK, .l_whence = SEEK_SET, .l_start = subdevice, .l_len = 1};
    return fcntl(it->fd, F_OFD_SETLK, &request) < 0 ? failed(EBUSY) : 0;
}
int comedi_get_n_channels(comedi_t *it, unsigned subdevice) { return channels[subdevice]; }
int comedi_get_n_ranges(comedi_t *it, unsigned subdevice, unsigned channel) { return ranges[subdevice]; }
range *comedi_get_range(comedi_t *it, unsigned subdevice, unsigned channel, unsigned index)
{
    return subdevice == 0 ? &input_ranges[index] : &output_ranges[index];
}
unsigned comedi_get_maxdata(comedi_t *it, unsigned subdevice, unsigned channel) { return MAXDATA; }

int comedi_data_read(comedi_t *it, unsigned subdevice, unsigned channel, unsigned index, unsigned aref, unsigned *data)
{
    if (it->board->fail_read) { it->board->fail_read--; return failed(EIO); }
    if (subdevice == 1 && channel < OUTPUTS && !it->board->mute) { *data = it->board->code[channel]; return 1; }
    if (subdevice != 0 || channel >= INPUTS) return failed(EINVAL);
    range in = input_ranges[index], out = {0};
    double volts = 0.0;
    if (channel < OUTPUTS) {
        out = output_ranges[it->board->range[channel]];
        volts = out.min + it->board->code[channel] * (out.max - out.min) / MAXDATA;
    }
    double code = (volts - in.min) / (in.max - in.min) * MAXDATA + 0.5;
    *data = code < 0 ? 0 : code > MAXDATA ? MAXDATA : (unsigned)code;
    return 1;
}

int comedi_data_write(comedi_t *it, unsigned subdevice, unsigned channel, unsigned index, unsigned aref, unsigned data)
{
    if (it->board->fail_write) { it->board->fail_write--; return failed(EIO); }
    if (subdevice != 1 || channel >= OUTPUTS || data > MAXDATA) return failed(EINVAL);
    it->board->code[channel] = data;
    it->board->range[channel] = index;
    return 1;
}

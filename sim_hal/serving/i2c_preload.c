/* Library for LD_PRELOAD with which unchanged programs can open an emulated I2C bus as /dev/i2c-N.
 *
 * If a program opens the device, the library connects to the server's socket (sim_hal/serving/emulate_i2c.py). On
 * this descriptor, read, write and the ioctls of linux/i2c-dev.h become requests to the server. Calls for all other
 * files are passed to the C library. A descriptor is recognised by the inode of its socket, so duplicates made by
 * dup and fork work, and close needs no wrapper. The functions stat and access find the device, but a listing of
 * /dev does not show it. The environment variable KNIGHTCUBE_I2C_SOCKET contains the path of the socket.
 * KNIGHTCUBE_I2C_BUS contains the number of the bus, or its device file if udev has given it another name.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <linux/i2c.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>
#include <sys/un.h>
#include <unistd.h>

enum { FUNCTIONS = 1, SMBUS = 2, MESSAGES = 3 };

#define BUSES 64          /* maximum number of simultaneous openings */
#define ROOM (1 << 16)    /* maximum length of a request or an answer, bytes */
#define UNION 34          /* size of union i2c_smbus_data, bytes */

struct bus {
    dev_t device;
    ino_t inode;
    uint16_t address;
};

static struct bus buses[BUSES];
static unsigned opened;
static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
static uint8_t room[ROOM]; /* the mutex protects this buffer and the variables above */

static void *next(const char *name) { return dlsym(RTLD_NEXT, name); }

static int is_bus(const char *path)
{
    const char *number = getenv("KNIGHTCUBE_I2C_BUS");
    char name[64];
    if (path == NULL || number == NULL || getenv("KNIGHTCUBE_I2C_SOCKET") == NULL)
        return 0;
    if (number[0] == '/')
        return strcmp(path, number) == 0;
    if (strncmp(path, "/dev/i2c", 8) != 0)
        return 0;
    snprintf(name, sizeof name, "/dev/i2c-%s", number);
    if (strcmp(path, name) == 0)
        return 1;
    name[8] = '/'; /* older name of the device file, /dev/i2c/N */
    return strcmp(path, name) == 0;
}

static struct bus *bus_of(int fd)
{
    struct stat status;
    int error = errno;
    struct bus *found = NULL;
    if (opened != 0 && fstat(fd, &status) == 0 && S_ISSOCK(status.st_mode))
        for (unsigned i = 0; i < BUSES; i++)
            if (buses[i].inode == status.st_ino && buses[i].device == status.st_dev)
                found = &buses[i];
    errno = error;
    return found;
}

static int open_bus(int flags)
{
    struct sockaddr_un place = {.sun_family = AF_UNIX};
    struct stat status;
    int fd = socket(AF_UNIX, SOCK_STREAM | (flags & O_CLOEXEC ? SOCK_CLOEXEC : 0), 0);
    if (fd < 0)
        return -1;
    strncpy(place.sun_path, getenv("KNIGHTCUBE_I2C_SOCKET"), sizeof place.sun_path - 1);
    if (connect(fd, (struct sockaddr *)&place, sizeof place) != 0 || fstat(fd, &status) != 0) {
        close(fd);
        errno = ENODEV; /* the server has ended */
        return -1;
    }
    pthread_mutex_lock(&mutex);
    buses[opened++ % BUSES] = (struct bus){status.st_dev, status.st_ino, 0};
    pthread_mutex_unlock(&mutex);
    return fd;
}

static int move(int fd, uint8_t *data, size_t length, int sending)
{
    while (length > 0) {
        ssize_t done = sending ? send(fd, data, length, MSG_NOSIGNAL) : recv(fd, data, length, 0);
        if (done < 0 && errno == EINTR)
            continue;
        if (done <= 0)
            return -1;
        data += done;
        length -= done;
    }
    return 0;
}

/* Send the first `length` bytes of `room` as one request, store the answer in `room`, and return the length of the
 * answer, or -1 after an error. */
static ssize_t ask(int fd, uint32_t length)
{
    int32_t head[2]; /* errno or 0, and number of bytes that follow */
    if (move(fd, (uint8_t *)&length, sizeof length, 1) || move(fd, room, length, 1) ||
        move(fd, (uint8_t *)head, sizeof head, 0) || head[1] > ROOM || move(fd, room, head[1], 0)) {
        errno = ENODEV;
        return -1;
    }
    if (head[0] != 0) {
        errno = head[0];
        return -1;
    }
    return head[1];
}

static int functions(int fd, unsigned long *mask)
{
    uint32_t given;
    room[0] = FUNCTIONS;
    if (ask(fd, 1) != sizeof given)
        return -1;
    memcpy(&given, room, sizeof given);
    *mask = given;
    return 0;
}

static int smbus(int fd, uint16_t address, struct i2c_smbus_ioctl_data *transfer)
{
    uint8_t *data = (uint8_t *)transfer->data;
    uint32_t size = transfer->size;
    room[0] = SMBUS;
    room[1] = transfer->read_write == I2C_SMBUS_READ;
    room[2] = transfer->command;
    memcpy(room + 3, &size, sizeof size);
    memcpy(room + 7, &address, sizeof address);
    if (data == NULL)
        memset(room + 9, 0, UNION);
    else /* only blocks are longer than a word */
        memcpy(room + 9, data, size > I2C_SMBUS_PROC_CALL ? UNION : 2);
    ssize_t given = ask(fd, 9 + UNION);
    if (given < 0)
        return -1;
    if (data != NULL && given <= UNION)
        memcpy(data, room, given);
    return 0;
}

static int messages(int fd, struct i2c_msg *message, uint32_t count)
{
    uint32_t length = 2;
    if (count > I2C_RDWR_IOCTL_MAX_MSGS) {
        errno = EINVAL;
        return -1;
    }
    room[0] = MESSAGES;
    room[1] = count;
    for (uint32_t i = 0; i < count; i++) {
        uint16_t head[3] = {message[i].addr, message[i].flags, message[i].len};
        uint32_t written = message[i].flags & I2C_M_RD ? 0 : message[i].len;
        if (length + sizeof head + written > ROOM) {
            errno = EINVAL;
            return -1;
        }
        memcpy(room + length, head, sizeof head);
        memcpy(room + length + sizeof head, message[i].buf, written);
        length += sizeof head + written;
    }
    if (ask(fd, length) < 0)
        return -1;
    for (uint32_t i = 0, at = 0; i < count; i++)
        if (message[i].flags & I2C_M_RD) {
            memcpy(message[i].buf, room + at, message[i].len);
            at += message[i].len;
        }
    return count;
}

static int control(int fd, struct bus *bus, unsigned long request, void *argument)
{
    struct i2c_rdwr_ioctl_data *several = argument;
    unsigned long value = (unsigned long)argument;
    switch (request) {
    case I2C_SLAVE:
    case I2C_SLAVE_FORCE:
        if (value > 0x7F)
            break;
        bus->address = value;
        return 0;
    case I2C_TENBIT:
    case I2C_PEC: /* ten-bit addresses and packet error checking are not supported */
        if (value != 0)
            break;
        return 0;
    case I2C_RETRIES:
    case I2C_TIMEOUT:
        return 0;
    case I2C_FUNCS:
        return functions(fd, argument);
    case I2C_SMBUS:
        return smbus(fd, bus->address, argument);
    case I2C_RDWR:
        return messages(fd, several->msgs, several->nmsgs);
    default:
        errno = ENOTTY;
        return -1;
    }
    errno = EINVAL;
    return -1;
}

static ssize_t plain(int fd, struct bus *bus, void *data, size_t length, int reading)
{
    struct i2c_msg message = {bus->address, reading ? I2C_M_RD : 0, length > 8192 ? 8192 : length, data};
    pthread_mutex_lock(&mutex);
    int done = messages(fd, &message, 1);
    pthread_mutex_unlock(&mutex);
    return done < 0 ? -1 : message.len;
}

int ioctl(int fd, unsigned long request, ...)
{
    va_list rest;
    va_start(rest, request);
    void *argument = va_arg(rest, void *);
    va_end(rest);
    struct bus *bus = bus_of(fd);
    if (bus == NULL)
        return ((int (*)(int, unsigned long, ...))next("ioctl"))(fd, request, argument);
    pthread_mutex_lock(&mutex);
    int done = control(fd, bus, request, argument);
    pthread_mutex_unlock(&mutex);
    return done;
}

ssize_t read(int fd, void *data, size_t length)
{
    struct bus *bus = bus_of(fd);
    if (bus == NULL)
        return ((ssize_t(*)(int, void *, size_t))next("read"))(fd, data, length);
    return plain(fd, bus, data, length, 1);
}

ssize_t write(int fd, const void *data, size_t length)
{
    struct bus *bus = bus_of(fd);
    if (bus == NULL)
        return ((ssize_t(*)(int, const void *, size_t))next("write"))(fd, data, length);
    return plain(fd, bus, (void *)data, length, 0);
}

#define MODE(flags) \
    va_list rest; \
    va_start(rest, flags); \
    mode_t mode = (flags) & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0; \
    va_end(rest);

#define OPEN(name) \
    int name(const char *path, int flags, ...) \
    { \
        MODE(flags) \
        if (is_bus(path)) \
            return open_bus(flags); \
        return ((int (*)(const char *, int, ...))next(#name))(path, flags, mode); \
    }

#define OPENAT(name) \
    int name(int folder, const char *path, int flags, ...) \
    { \
        MODE(flags) \
        if (is_bus(path)) \
            return open_bus(flags); \
        return ((int (*)(int, const char *, int, ...))next(#name))(folder, path, flags, mode); \
    }

OPEN(open)
OPEN(open64)
OPEN(__open_2)
OPEN(__open64_2)
OPENAT(openat)
OPENAT(openat64)
OPENAT(__openat_2)
OPENAT(__openat64_2)

#define I2C_MAJOR 89

#define STAT(name, kind) \
    int name(const char *path, struct kind *status) \
    { \
        int bus = is_bus(path); \
        if (bus) \
            path = getenv("KNIGHTCUBE_I2C_SOCKET"); \
        int done = ((int (*)(const char *, struct kind *))next(#name))(path, status); \
        if (bus && done == 0) { \
            status->st_mode = S_IFCHR | 0660; \
            status->st_rdev = makedev(I2C_MAJOR, atoi(getenv("KNIGHTCUBE_I2C_BUS"))); \
        } \
        return done; \
    }

#define STATAT(name, kind) \
    int name(int folder, const char *path, struct kind *status, int flags) \
    { \
        int (*plain)(int, const char *, struct kind *, int) = next(#name); \
        if (!is_bus(path)) \
            return plain(folder, path, status, flags); \
        int done = plain(AT_FDCWD, getenv("KNIGHTCUBE_I2C_SOCKET"), status, 0); \
        status->st_mode = S_IFCHR | 0660; \
        status->st_rdev = makedev(I2C_MAJOR, atoi(getenv("KNIGHTCUBE_I2C_BUS"))); \
        return done; \
    }

STAT(stat, stat)
STAT(lstat, stat)
STAT(stat64, stat64)
STAT(lstat64, stat64)
STATAT(fstatat, stat)
STATAT(fstatat64, stat64)

int access(const char *path, int mode)
{
    return ((int (*)(const char *, int))next("access"))(is_bus(path) ? getenv("KNIGHTCUBE_I2C_SOCKET") : path, mode);
}

int faccessat(int folder, const char *path, int mode, int flags)
{
    int (*plain)(int, const char *, int, int) = next("faccessat");
    return is_bus(path) ? plain(AT_FDCWD, getenv("KNIGHTCUBE_I2C_SOCKET"), mode, 0) : plain(folder, path, mode, flags);
}

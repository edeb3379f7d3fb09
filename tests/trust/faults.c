// Preloaded into a process, makes the operating system fail: the n-th operation that changes something below a folder
// fails once with an error number, or the process is killed at the n-th rename there, or after some CPU time.
//
// Counted are creating a file, making a folder, write, fsync, ftruncate and rename.

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

enum { COUNT = 0, FAIL_ONCE = 1, FAIL_FROM = 2, KILL_BEFORE_RENAME = 3, KILL_AFTER_RENAME = 4 };

static char below[PATH_MAX];
static int how, number;
static long at, operations, renames;

void d2_fault_arm(const char *folder, int mode, long place, int error) {
  strncpy(below, folder, sizeof below - 1);
  how = mode, at = place, number = error, operations = 0, renames = 0;
}

// SIGKILL when the process has used so many more CPU seconds: the same moment of its work however busy the machine is.
int d2_fault_kill_after(double seconds) {
  struct sigevent event;
  memset(&event, 0, sizeof event);
  event.sigev_notify = SIGEV_SIGNAL;
  event.sigev_signo = SIGKILL;
  timer_t timer;
  if (timer_create(CLOCK_PROCESS_CPUTIME_ID, &event, &timer) != 0) return -1;
  struct itimerspec limit;
  memset(&limit, 0, sizeof limit);
  limit.it_value.tv_sec = (time_t)seconds;
  limit.it_value.tv_nsec = (long)((seconds - (double)limit.it_value.tv_sec) * 1e9) + 1;
  return timer_settime(timer, 0, &limit, NULL);
}

long d2_fault_operations(void) { return operations; }
long d2_fault_renames(void) { return renames; }

static int watched(const char *path) {
  return below[0] && path && strncmp(path, below, strlen(below)) == 0;
}

static int watched_descriptor(int descriptor) {
  char name[64], path[PATH_MAX];
  if (!below[0]) return 0;
  snprintf(name, sizeof name, "/proc/self/fd/%d", descriptor);
  ssize_t length = readlink(name, path, sizeof path - 1);
  if (length < 0) return 0;
  path[length] = 0;
  return watched(path);
}

// Whether this operation, one on what is watched, has to fail.
static int fails(void) {
  long place = operations++;
  if ((how == FAIL_ONCE && place == at) || (how == FAIL_FROM && place >= at)) {
    errno = number;
    return 1;
  }
  return 0;
}

#define NEXT(type, name, ...) type (*next)(__VA_ARGS__) = (type (*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)

#define OPEN(name)                                                    \
  int name(const char *path, int flags, ...) {                        \
    NEXT(int, #name, const char *, int, ...);                         \
    va_list rest;                                                     \
    va_start(rest, flags);                                            \
    mode_t mode = (flags & (O_CREAT | O_TMPFILE)) ? va_arg(rest, mode_t) : 0; \
    va_end(rest);                                                     \
    if ((flags & O_CREAT) && watched(path) && fails()) return -1;     \
    return next(path, flags, mode);                                   \
  }

OPEN(open)
OPEN(open64)

int mkdir(const char *path, mode_t mode) {
  NEXT(int, "mkdir", const char *, mode_t);
  struct stat found;
  if (watched(path) && stat(path, &found) != 0 && fails()) return -1;
  return next(path, mode);
}

ssize_t write(int descriptor, const void *data, size_t count) {
  NEXT(ssize_t, "write", int, const void *, size_t);
  if (count > 0 && watched_descriptor(descriptor)) {
    if (fails()) {
      if (count > 1 && number == ENOSPC) next(descriptor, data, count / 2);  // a full disk takes what still fits
      errno = number;
      return -1;
    }
  }
  return next(descriptor, data, count);
}

int fsync(int descriptor) {
  NEXT(int, "fsync", int);
  if (watched_descriptor(descriptor) && fails()) return -1;
  return next(descriptor);
}

int rename(const char *from, const char *to) {
  NEXT(int, "rename", const char *, const char *);
  if (!watched(to)) return next(from, to);
  if (fails()) return -1;
  long place = renames++;
  if (how == KILL_BEFORE_RENAME && place == at) kill(getpid(), SIGKILL);
  int result = next(from, to);
  if (how == KILL_AFTER_RENAME && place == at) kill(getpid(), SIGKILL);
  return result;
}

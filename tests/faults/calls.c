/* Loaded before the C library: at call number FAULT_AT on a path that contains FAULT_PATH something happens.
   FAULT_CALL is the name of a system call, or "*" for every call that changes a file or a folder.
   FAULT_ERRNO > 0: this call and all later ones fail with this error. 0: SIGKILL before the call. -1: SIGKILL in the
   middle of a write. Without FAULT_AT calls are counted only. The count starts again when FAULT_CASE changes.
   FAULT_FLUSHED is a folder for the content of every file at its last flush, by inode. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#define REAL(name) static __typeof__(name) *real; if (!real) real = (__typeof__(name) *)dlsym(RTLD_NEXT, #name)
enum { PASS, FAIL, TEAR };
static int count;

int fault_count(void) { return __atomic_load_n(&count, __ATOMIC_SEQ_CST); }

static int fault(const char *call, const char *path) {
  static char seen[64];
  const char *wanted = getenv("FAULT_CALL"), *part = getenv("FAULT_PATH"), *name = getenv("FAULT_CASE");
  const char *at = getenv("FAULT_AT"), *number = getenv("FAULT_ERRNO");
  if (!wanted || !part || !name) return PASS;
  if (strcmp(wanted, "*") ? strcmp(wanted, call) : !strcmp(call, "read")) return PASS;
  if (!strstr(path, part)) return PASS;
  if (strcmp(seen, name)) { snprintf(seen, sizeof seen, "%s", name); count = 0; }
  int now = __atomic_add_fetch(&count, 1, __ATOMIC_SEQ_CST), error = number ? atoi(number) : 0;
  if (!at || now < atoi(at)) return PASS;
  if (error < 0 && !strcmp(call, "write")) return TEAR;
  if (error <= 0) { kill(getpid(), SIGKILL); pause(); }
  errno = error;
  return FAIL;
}

static int of_file(int fd, char *path, size_t size) {
  char link[64];
  snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
  ssize_t length = readlink(link, path, size - 1);
  path[length < 0 ? 0 : length] = 0;
  return length >= 0;
}

static int by_fd(const char *call, int fd) {
  char path[4096];
  return of_file(fd, path, sizeof path) ? fault(call, path) : PASS;
}

static int by_name(const char *call, int folder, const char *name) {
  char path[8192] = "";
  if (name[0] == '/') return fault(call, name);
  if (folder != AT_FDCWD) { if (!of_file(folder, path, 4096)) return PASS; }
  else if (!getcwd(path, 4096)) return PASS;
  strncat(path, "/", 2); strncat(path, name, 4000);
  return fault(call, path);
}

static void torn(int fd, const void *data, size_t size, off_t at) {
  static __typeof__(pwrite) *put; static __typeof__(write) *append;
  put = dlsym(RTLD_NEXT, "pwrite"); append = dlsym(RTLD_NEXT, "write");
  if (at < 0) append(fd, data, size / 2); else put(fd, data, size / 2, at);
  kill(getpid(), SIGKILL); pause();
}

static void forget(int folder, const char *name) {
  const char *kept = getenv("FAULT_FLUSHED");
  struct stat found; char copy[4096];
  if (!kept || fstatat(folder, name, &found, AT_SYMLINK_NOFOLLOW) || !S_ISREG(found.st_mode) || found.st_nlink > 1) return;
  snprintf(copy, sizeof copy, "%s/%lu", kept, (unsigned long)found.st_ino);
  static __typeof__(unlink) *gone; gone = dlsym(RTLD_NEXT, "unlink"); gone(copy);
}

static void keep(int fd) {
  const char *kept = getenv("FAULT_FLUSHED");
  struct stat found; char copy[4096], link[64], data[65536];
  if (!kept || fstat(fd, &found) || !S_ISREG(found.st_mode)) return;
  static __typeof__(open) *raw; static __typeof__(write) *put; static __typeof__(read) *get;
  raw = dlsym(RTLD_NEXT, "open"); put = dlsym(RTLD_NEXT, "write"); get = dlsym(RTLD_NEXT, "read");
  snprintf(copy, sizeof copy, "%s/%lu", kept, (unsigned long)found.st_ino);
  snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
  int from = raw(link, O_RDONLY), to = raw(copy, O_WRONLY | O_CREAT | O_TRUNC, 0600);
  for (ssize_t n; from >= 0 && to >= 0 && (n = get(from, data, sizeof data)) > 0;) if (put(to, data, n) < 0) break;
  close(from); close(to);
}

#define WRITE(name, ...) { REAL(name); int does = by_fd("write", f); \
  if (does == TEAR) torn(f, b, n, at); \
  return does ? -1 : real(__VA_ARGS__); }
ssize_t pwrite(int f, const void *b, size_t n, off_t at) WRITE(pwrite, f, b, n, at)
ssize_t pwrite64(int f, const void *b, size_t n, off64_t at) WRITE(pwrite64, f, b, n, at)
ssize_t write(int f, const void *b, size_t n) { off_t at = -1; WRITE(write, f, b, n) }
ssize_t pread(int f, void *b, size_t n, off_t o) { REAL(pread); return by_fd("read", f) ? -1 : real(f, b, n, o); }
ssize_t pread64(int f, void *b, size_t n, off64_t o) { REAL(pread64); return by_fd("read", f) ? -1 : real(f, b, n, o); }
int ftruncate(int f, off_t n) { REAL(ftruncate); return by_fd("ftruncate", f) ? -1 : real(f, n); }
int ftruncate64(int f, off64_t n) { REAL(ftruncate64); return by_fd("ftruncate", f) ? -1 : real(f, n); }
int posix_fallocate(int f, off_t o, off_t n) { REAL(posix_fallocate); return by_fd("fallocate", f) ? errno : real(f, o, n); }
int posix_fallocate64(int f, off64_t o, off64_t n) {
  REAL(posix_fallocate64); return by_fd("fallocate", f) ? errno : real(f, o, n);
}
#define FLUSH(name) int name(int f) { REAL(name); if (by_fd("fsync", f)) return -1; \
  int done = real(f); if (!done) keep(f); return done; }
FLUSH(fsync)
FLUSH(fdatasync)
#define OPEN(name, folder, ...) { \
  REAL(name); mode_t mode = 0; \
  if (flags & (O_CREAT | O_TMPFILE)) { va_list more; va_start(more, flags); mode = va_arg(more, mode_t); va_end(more); } \
  if (flags & (O_CREAT | O_TRUNC) && by_name("open", folder, path)) return -1; \
  return real(__VA_ARGS__, mode); }
int open(const char *path, int flags, ...) OPEN(open, AT_FDCWD, path, flags)
int open64(const char *path, int flags, ...) OPEN(open64, AT_FDCWD, path, flags)
int openat(int folder, const char *path, int flags, ...) OPEN(openat, folder, folder, path, flags)
int openat64(int folder, const char *path, int flags, ...) OPEN(openat64, folder, folder, path, flags)
int rename(const char *a, const char *b) {
  REAL(rename); if (by_name("rename", AT_FDCWD, b)) return -1; forget(AT_FDCWD, b); return real(a, b);
}
int renameat(int f, const char *a, int g, const char *b) {
  REAL(renameat); if (by_name("rename", g, b)) return -1; forget(g, b); return real(f, a, g, b);
}
int unlink(const char *a) { REAL(unlink); if (by_name("unlink", AT_FDCWD, a)) return -1; forget(AT_FDCWD, a); return real(a); }
int unlinkat(int f, const char *a, int flags) {
  REAL(unlinkat); if (by_name("unlink", f, a)) return -1; forget(f, a); return real(f, a, flags);
}
int rmdir(const char *a) { REAL(rmdir); return by_name("rmdir", AT_FDCWD, a) ? -1 : real(a); }
int mkdir(const char *a, mode_t m) { REAL(mkdir); return by_name("mkdir", AT_FDCWD, a) ? -1 : real(a, m); }
int mkdirat(int f, const char *a, mode_t m) { REAL(mkdirat); return by_name("mkdir", f, a) ? -1 : real(f, a, m); }
int link(const char *a, const char *b) { REAL(link); return by_name("link", AT_FDCWD, b) ? -1 : real(a, b); }
int symlink(const char *a, const char *b) { REAL(symlink); return by_name("link", AT_FDCWD, b) ? -1 : real(a, b); }

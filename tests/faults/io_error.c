/* Loaded before the C library: from call number FAULT_AT on, the system call FAULT_CALL fails with FAULT_ERRNO on files
   whose path contains FAULT_PATH. The count starts again when FAULT_CASE changes. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static int fails(const char *call, int fd) {
  static int count;
  static char seen[64];
  const char *wanted = getenv("FAULT_CALL"), *part = getenv("FAULT_PATH"), *name = getenv("FAULT_CASE");
  char link[64], path[4096];
  ssize_t length;
  if (!wanted || !part || !name || strcmp(wanted, call)) return 0;
  snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
  length = readlink(link, path, sizeof path - 1);
  if (length < 0) return 0;
  path[length] = 0;
  if (!strstr(path, part)) return 0;
  if (strcmp(seen, name)) { snprintf(seen, sizeof seen, "%s", name); count = 0; }
  if (++count < atoi(getenv("FAULT_AT"))) return 0;
  errno = atoi(getenv("FAULT_ERRNO"));
  return 1;
}

#define REAL(name) static __typeof__(name) *real; if (!real) real = (__typeof__(name) *)dlsym(RTLD_NEXT, #name)

ssize_t pwrite(int f, const void *b, size_t n, off_t o) { REAL(pwrite); return fails("write", f) ? -1 : real(f, b, n, o); }
ssize_t pwrite64(int f, const void *b, size_t n, off64_t o) { REAL(pwrite64); return fails("write", f) ? -1 : real(f, b, n, o); }
ssize_t write(int f, const void *b, size_t n) { REAL(write); return fails("write", f) ? -1 : real(f, b, n); }
ssize_t pread(int f, void *b, size_t n, off_t o) { REAL(pread); return fails("read", f) ? -1 : real(f, b, n, o); }
ssize_t pread64(int f, void *b, size_t n, off64_t o) { REAL(pread64); return fails("read", f) ? -1 : real(f, b, n, o); }
int ftruncate(int f, off_t n) { REAL(ftruncate); return fails("ftruncate", f) ? -1 : real(f, n); }
int ftruncate64(int f, off64_t n) { REAL(ftruncate64); return fails("ftruncate", f) ? -1 : real(f, n); }
int fsync(int f) { REAL(fsync); return fails("fsync", f) ? -1 : real(f); }

/* What our C calls of string.h, for a compiler that brings no headers of the system. */
#ifndef SYSID_STRING_H
#define SYSID_STRING_H
#include <stddef.h>
void *memcpy(void *to, const void *from, size_t count), *memmove(void *to, const void *from, size_t count);
void *memset(void *to, int value, size_t count);
#endif

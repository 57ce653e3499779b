/* Integers of stated widths on systems with 64 bits, for a compiler that brings no headers of the system. */
#ifndef SYSID_STDINT_H
#define SYSID_STDINT_H
typedef signed char int8_t;
typedef unsigned char uint8_t;
typedef short int16_t;
typedef unsigned short uint16_t;
typedef int int32_t;
typedef unsigned int uint32_t;
typedef long long int64_t;
typedef unsigned long long uint64_t;
#endif

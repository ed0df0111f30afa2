/* Generated: the sampled system's groups of variables and its sampling time. */
#ifndef SYSTEM_H
#define SYSTEM_H

enum { FIRST_INPUT = 1, FIRST_OUTPUT = {{ first_output }}, FIRST_PARAMETER = {{ first_parameter }} };

#define SAMPLING_TIME {{ sampling_time }}

#endif

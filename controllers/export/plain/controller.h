/* $title
 *
 * Written by `cosim export --format c` of rti-cosim $version (MIT licence). C99, no FMI, no
 * allocation, no files; of libm only sqrt and copysign, besides what the model calls.
 *
 *     static $Name controller;
 *     ${name}_init(&controller);
 *     every $sampling_time s:
 *         status = ${name}_step(&controller, $arguments$known_value, action);
 */
#ifndef ${NAME}_H
#define ${NAME}_H

#ifdef __cplusplus
extern "C" {
#endif

#define ${NAME}_SAMPLING_TIME $sampling_time /* s */

enum {
    ${NAME}_STATES = $n,  /* $states */
$sizes$known_size    ${NAME}_ACTIONS = $m, /* $actions */
    ${NAME}_THETA = $parameters,
    ${NAME}_MEMORY = $memory
};

/* What a sample may end with. All but the first hold the last action (at first the reference). */
enum {
$statuses
};

/* theta may be changed between samples; the other members are the controller's own. */
typedef struct {
    double theta[${NAME}_THETA];
    double memory[${NAME}_MEMORY];
} $Name;

typedef struct {
    double value;        /* V of the state */
    double kkt_residual; /* the largest, of the last QP that was solved */
    int iterations;      /* of the QP solver, in that QP */
    double failures;     /* samples that held the last action, so far */
$members} ${Name}Report;

/* The trained theta, the reference action, no memory of earlier samples. */
void ${name}_init($Name *controller);

/* The action$about */
int ${name}_step($Name *controller, $measured$known_argument, double action[${NAME}_ACTIONS]);

/* In manual, in the place of ${name}_step: `action` is the operator's and comes back within its bounds,
 * whatever the status. The controller follows it, so that the next ${name}_step goes on from there. */
int ${name}_manual($Name *controller, $measured$known_argument, double action[${NAME}_ACTIONS]);

/* A status in words. */
const char *${name}_message(int status);

/* On the last sample. */
void ${name}_report(const $Name *controller, ${Name}Report *report);

#ifdef __cplusplus
}
#endif

#endif

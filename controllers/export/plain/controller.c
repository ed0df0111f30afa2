/* $title
 *
 * Written by `cosim export --format c` of rti-cosim $version; see $name.h.
 *
 * A sample's arrays are static, for small stacks: one controller steps at a time. With
 * -DQP_SCRATCH= they are on the stack, and several may step at once. QP_ITERATIONS caps the QP
 * solver's steps; a QP that needs more is a failure.
 */
#include "$name.h"

#ifndef QP_SCRATCH
#define QP_SCRATCH static
#endif

$core
static const double TRAINED[] = {$theta};

/* Fails to compile where the header's memory is too small. */
typedef char memory_suffices[sizeof(CoreState) <= sizeof(double) * ${NAME}_MEMORY ? 1 : -1];

void ${name}_init($Name *controller) {
    memset(controller, 0, sizeof *controller);
    memcpy(controller->theta, TRAINED, sizeof controller->theta);
    core_reset((CoreState *)controller->memory);
}

static int sample($Name *controller, const double inputs[], const double known[],
                  const double manual[], double action[]) {
    CoreState *const core = (CoreState *)controller->memory;
    double given[N_GIVEN];
    core_given(controller->theta, known, given);
    core_act(core, inputs, manual, given);
    core_commit(core);
    memcpy(action, core->applied, sizeof core->applied);
    return (int)core->status;
}

${gather}int ${name}_step($Name *controller, $measured$known_argument, double action[${NAME}_ACTIONS]) {
${gathered}    return sample(controller, $inputs, $known, 0, action);
}

int ${name}_manual($Name *controller, $measured$known_argument, double action[${NAME}_ACTIONS]) {
${gathered}    return sample(controller, $inputs, $known, action, action);
}

const char *${name}_message(int status) {
    const int count = (int)(sizeof CORE_MESSAGES / sizeof CORE_MESSAGES[0]);
    return status >= 0 && status < count ? CORE_MESSAGES[status] : "none";
}

void ${name}_report(const $Name *controller, ${Name}Report *report) {
    const CoreState *const core = (const CoreState *)controller->memory;
    report->value = core->solution.value;
    report->kkt_residual = core->solution.residual;
    report->iterations = (int)core->solution.iterations;
    report->failures = core->failures;
$report}

/* FMI 3.0's arrays. An array has its first element's value reference, its further elements have none of their own.
 *
 * fmi3.c knows scalars alone: here its calls for the values of reals go through the arrays. Generated from the table of
 * {{ model.name }}; do not edit. */
#ifndef ARRAYS_H
#define ARRAYS_H

#include "access.h"

/* How many elements a value reference stands for, none for a further element; and which is the next one. */
static const struct {
    unsigned count, next;
} ELEMENTS[N_VARIABLES] = {
{% for count, next in elements %}
    {{ "{" }}{{ count }}, {{ next }}},
{% endfor %}
};

/* Every count but an array's of reals is 1: what has passed here and finds no real does not read beyond its arrays. */
static Status check_elements(const Instance *instance, const char *function, const void *vr, size_t n_vr,
                             const void *values, size_t n_values) {
    const unsigned *const reference = vr;
    const Status status = check_arrays(instance, function, vr, n_vr, values, n_vr);
    size_t n = 0;
    for (size_t i = 0; status == OK && i < n_vr; i++) {
        const unsigned count = reference[i] < N_VARIABLES ? ELEMENTS[reference[i]].count : 0;
        if (count == 0)
            return report(instance, ERROR, "%s: unknown value reference %u.", function, reference[i]);
        n += count;
    }
    if (status != OK || n == n_values) return status;
    return report(instance, ERROR, "%s: %zu elements but %zu values.", function, n, n_values);
}

/* Of `n` elements; `check_elements` has passed. */
static Status get_elements(Instance *instance, const char *function, VariableType type, const unsigned vr[],
                           size_t n, double value[]) {
    for (size_t k = 0; k < n; vr++)
        for (unsigned count = ELEMENTS[*vr].count, element = *vr; count > 0; count--, k++) {
            const Status status = get_values(instance, function, type, &element, 1, value + k);
            if (status != OK) return status;
            element = ELEMENTS[element].next;
        }
    return OK;
}

/* All values are checked before any is taken over: a refused call changes nothing. */
static Status set_elements(Instance *instance, const char *function, VariableType type, const unsigned vr[],
                           size_t n, const double value[]) {
    for (int checked = 0; checked < 2; checked++) {
        const unsigned *array = vr;
        for (size_t k = 0; k < n; array++)
            for (unsigned count = ELEMENTS[*array].count, element = *array; count > 0; count--, k++) {
                Status status = check_reference(instance, function, element, type);
                if (status == OK && !checked) status = check_value(instance, function, element, value[k]);
                if (status != OK) return status;
                if (checked) set_value(&instance->state, element, value[k]);
                element = ELEMENTS[element].next;
            }
    }
    return OK;
}

#define check_arrays check_elements
#define get_values get_elements
#define set_values set_elements

#endif

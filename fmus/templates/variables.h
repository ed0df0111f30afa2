/* Generated from {{ origin }}; do not edit. */
#ifndef VARIABLES_H
#define VARIABLES_H

#ifndef FMI2_FUNCTION_PREFIX
#define FMI2_FUNCTION_PREFIX {{ model.identifier }}_
#endif
#ifndef FMI3_FUNCTION_PREFIX
#define FMI3_FUNCTION_PREFIX {{ model.identifier }}_
#endif

#define MODEL_TOKEN "{{ token }}"

/* Digest of the variables' names and order: marks the layout of a serialised state. */
#define LAYOUT_DIGEST UINT64_C(0x{{ layout }})

enum {
{% for variable in model.variables %}
    VR_{{ variable.identifier }} = {{ loop.index0 }},
{% endfor %}
    N_VARIABLES = {{ model.variables|length }}
};

typedef enum { {{ types|join(", ") }} } VariableType;

typedef enum { {{ kinds|join(", ") }} } VariableKind;

typedef struct {
    const char *name;
    VariableType type;
    VariableKind kind;
    double start, min, max, nominal;
} VariableInfo;

static const VariableInfo VARIABLES[N_VARIABLES] = {
{% for variable in model.variables %}
    {"{{ variable.name }}", {{ variable.type.name }}, {{ variable.kind.name }}, {{ numbers(variable)|join(", ") }}},
{% endfor %}
};

#endif

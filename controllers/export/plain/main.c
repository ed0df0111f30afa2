/* Reads measured $what from standard input, one sample a line, and writes actions, status,
 * iterations of the QP solver and value:    printf '25 50\n26 51\n' | ./example
$note */
#include <stdio.h>

#include "$name.h"

int main(void) {
    static $Name controller;
    double ${given}[$size], action[${NAME}_ACTIONS];
$fresh$known_declaration    ${Name}Report report;
    ${name}_init(&controller);
    for (;;) {
        for (int i = 0; i < $size; i++)
            if (scanf("%lf", &${given}[i]) != 1) return 0;
${mark}${known_read}        const int status = ${name}_step(&controller, $arguments$known_value, action);
        ${name}_report(&controller, &report);
        for (int i = 0; i < ${NAME}_ACTIONS; i++) printf("%.17g ", action[i]);
        printf("%d %d %.17g\n", status, report.iterations, report.value);
    }
}

/* Reads measured states from standard input, one sample a line, and writes actions, status,
 * iterations of the QP solver and value:    printf '25 50\n26 51\n' | ./example
 */
#include <stdio.h>

#include "$name.h"

int main(void) {
    static $Name controller;
    double state[${NAME}_STATES], action[${NAME}_ACTIONS];
    ${Name}Report report;
    ${name}_init(&controller);
    for (;;) {
        for (int i = 0; i < ${NAME}_STATES; i++)
            if (scanf("%lf", &state[i]) != 1) return 0;
        const int status = ${name}_step(&controller, state, action);
        ${name}_report(&controller, &report);
        for (int i = 0; i < ${NAME}_ACTIONS; i++) printf("%.17g ", action[i]);
        printf("%d %d %.17g\n", status, report.iterations, report.value);
    }
}

/* The state as it is measured, where there is no estimator. */
#ifndef STATE_MEASURED_H
#define STATE_MEASURED_H

enum { OBSERVER_INPUTS = N_X };

typedef struct {
    double s[N_X];
} Observer;

static inline void observer_reset(Observer *observer) { memset(observer, 0, sizeof *observer); }

/* The present state. */
static inline const double *observer_take(Observer *observer, const double inputs[],
                                          const double theta[]) {
    (void)theta;
    memcpy(observer->s, inputs, sizeof observer->s);
    return observer->s;
}

/* A state that is known tightens no bound. */
static inline void observer_tighten(const Observer *observer, double theta[]) {
    (void)observer, (void)theta;
}

/* The sample ends with an action. */
static inline void observer_commit(Observer *observer, const double action[]) {
    (void)observer, (void)action;
}

/* A sensor may have failed: any state is plausible. */
static inline int observer_plausible(const Observer *observer) {
    (void)observer;
    return 1;
}

/* Outputs behind the controller's own: none. */
static inline void observer_outputs(const Observer *observer, double y[]) {
    (void)observer, (void)y;
}

#endif

/* A carriage on a spring with a damper, as FMI 2.0 for co-simulation: force in, position out.
   Value references: 0 force, 1 position, 2 mass, 3 spring, 4 damper, 5 drag (against v |v|). */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    double value[6], speed;
} Carriage;

static void reset(Carriage *c) {
    const double start[6] = {0, 0, 2.0, 80.0, 3.0, 0};
    memcpy(c->value, start, sizeof start);
    c->speed = 0;
}

void *fmi2Instantiate(const char *name, int type, const char *guid, const char *place, const void *callbacks,
                      int visible, int logging) {
    Carriage *c = calloc(1, sizeof *c);
    reset(c);
    return c;
}
void fmi2FreeInstance(void *c) { free(c); }
int fmi2Reset(void *c) { reset(c); return 0; }
int fmi2SetupExperiment(void *c, int a, double b, double d, int e, double f) { return 0; }
int fmi2EnterInitializationMode(void *c) { return 0; }
int fmi2ExitInitializationMode(void *c) { return 0; }
int fmi2Terminate(void *c) { return 0; }
int fmi2SetReal(void *c, const unsigned r[], size_t n, const double v[]) {
    for (size_t i = 0; i < n; i++) ((Carriage *)c)->value[r[i]] = v[i];
    return 0;
}
int fmi2GetReal(void *c, const unsigned r[], size_t n, double v[]) {
    for (size_t i = 0; i < n; i++) v[i] = ((Carriage *)c)->value[r[i]];
    return 0;
}
int fmi2DoStep(void *c, double time, double step, int keep) {
    Carriage *s = c;
    double *x = s->value, h = step / 20;
#ifdef MISBEHAVES
    puts("a library that talks");
    if (x[3] > 500) abort();
    if (x[3] < 1) for (;;) {}
    if (x[2] < 0.1) return 3;
#endif
    for (int i = 0; i < 20; i++) {
        double v = s->speed, drag = x[5] * v * (v < 0 ? -v : v);
        double a = (x[0] - x[3] * x[1] - x[4] * v - drag) / x[2];
        s->speed += h * a;
        x[1] += h * s->speed;
    }
    return 0;
}

/* What the standard asks for and nobody calls. */
#define NEVER(name) int name(void) { return 3; }
NEVER(fmi2CancelStep)
NEVER(fmi2DeSerializeFMUstate)
NEVER(fmi2FreeFMUstate)
NEVER(fmi2GetBoolean)
NEVER(fmi2GetBooleanStatus)
NEVER(fmi2GetDirectionalDerivative)
NEVER(fmi2GetFMUstate)
NEVER(fmi2GetInteger)
NEVER(fmi2GetIntegerStatus)
NEVER(fmi2GetRealOutputDerivatives)
NEVER(fmi2GetRealStatus)
NEVER(fmi2GetStatus)
NEVER(fmi2GetString)
NEVER(fmi2GetStringStatus)
NEVER(fmi2GetTypesPlatform)
NEVER(fmi2GetVersion)
NEVER(fmi2SerializeFMUstate)
NEVER(fmi2SerializedFMUstateSize)
NEVER(fmi2SetBoolean)
NEVER(fmi2SetDebugLogging)
NEVER(fmi2SetFMUstate)
NEVER(fmi2SetInteger)
NEVER(fmi2SetRealInputDerivatives)
NEVER(fmi2SetString)

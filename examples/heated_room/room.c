// The heated room as a co-simulation unit of FMI 2, in C. `room.xml` is its model description.

#include <fmi2FunctionTypes.h>

#include <math.h>
#include <stdlib.h>

enum { POWER, OUTSIDE, TEMPERATURE, NUMBER };  // value references

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions* callbacks, fmi2Boolean visible, fmi2Boolean logging) {
    (void)name, (void)type, (void)guid, (void)resources, (void)callbacks, (void)visible, (void)logging;
    fmi2Real* values = calloc(NUMBER, sizeof *values);
    if (values) values[TEMPERATURE] = 18.0;
    return values;
}

void fmi2FreeInstance(fmi2Component room) { free(room); }

fmi2Status fmi2GetReal(fmi2Component room, const fmi2ValueReference references[], size_t count, fmi2Real values[]) {
    for (size_t i = 0; i < count; ++i) values[i] = ((fmi2Real*)room)[references[i]];
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component room, const fmi2ValueReference references[], size_t count,
                       const fmi2Real values[]) {
    for (size_t i = 0; i < count; ++i) ((fmi2Real*)room)[references[i]] = values[i];
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component room, fmi2Real time, fmi2Real step, fmi2Boolean final) {
    (void)time, (void)final;
    fmi2Real* values = room;
    const fmi2Real limit = values[OUTSIDE] + 15.0 * values[POWER];
    values[TEMPERATURE] = limit + (values[TEMPERATURE] - limit) * exp(-step / 36000.0);
    return fmi2OK;
}

const char* fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char* fmi2GetVersion(void) { return "2.0"; }

// Programs such as FMPy load every function of the standard.
#define NOTHING_TO_DO(name) fmi2Status name(void) { return fmi2OK; }
#define NOT_SUPPORTED(name) fmi2Status name(void) { return fmi2Error; }
NOTHING_TO_DO(fmi2SetDebugLogging)
NOTHING_TO_DO(fmi2SetupExperiment)
NOTHING_TO_DO(fmi2EnterInitializationMode)
NOTHING_TO_DO(fmi2ExitInitializationMode)
NOTHING_TO_DO(fmi2Terminate)
NOT_SUPPORTED(fmi2Reset)
NOT_SUPPORTED(fmi2GetInteger)
NOT_SUPPORTED(fmi2GetBoolean)
NOT_SUPPORTED(fmi2GetString)
NOT_SUPPORTED(fmi2SetInteger)
NOT_SUPPORTED(fmi2SetBoolean)
NOT_SUPPORTED(fmi2SetString)
NOT_SUPPORTED(fmi2GetFMUstate)
NOT_SUPPORTED(fmi2SetFMUstate)
NOT_SUPPORTED(fmi2FreeFMUstate)
NOT_SUPPORTED(fmi2SerializedFMUstateSize)
NOT_SUPPORTED(fmi2SerializeFMUstate)
NOT_SUPPORTED(fmi2DeSerializeFMUstate)
NOT_SUPPORTED(fmi2GetDirectionalDerivative)
NOT_SUPPORTED(fmi2SetRealInputDerivatives)
NOT_SUPPORTED(fmi2GetRealOutputDerivatives)
NOT_SUPPORTED(fmi2CancelStep)
NOT_SUPPORTED(fmi2GetStatus)
NOT_SUPPORTED(fmi2GetRealStatus)
NOT_SUPPORTED(fmi2GetIntegerStatus)
NOT_SUPPORTED(fmi2GetBooleanStatus)
NOT_SUPPORTED(fmi2GetStringStatus)

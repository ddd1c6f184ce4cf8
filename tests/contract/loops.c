/* Loops of C that call back, as simulators do. */

#include <signal.h>

typedef int (*callback)(int number);

/* Call back so often, unless that is stopped. Returns how often it has called. */
int loop(callback each, int times, const int *stopped)
{
    int number;
    for (number = 0; number < times && !*stopped; number++)
        each(number);
    return number;
}

/* Call back so often, with an interrupt that comes just before one of the calls. */
void loop_interrupted(callback each, int times, int at)
{
    for (int number = 0; number < times; number++) {
        if (number == at)
            raise(SIGINT);
        each(number);
    }
}

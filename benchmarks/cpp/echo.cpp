// The minimal process that asks over a pipe: it writes a line and reads a line, which it does not parse.

#include <unistd.h>

#include <cstdio>
#include <cstdlib>

int main(int, char** argv) {
    const int in = std::atoi(argv[1]), out = std::atoi(argv[2]);
    char line[256];
    for (long number = 1;; ++number) {
        const int length = std::snprintf(line, sizeof line,
                                         "{\"decide\": %ld, \"entity\": \"agent_%ld\", \"point\": \"noop.turn\", "
                                         "\"args\": {\"values\": [0.1, 0.2, 0.3, 0.4]}}\n",
                                         number, 1 - number % 2);
        if (write(out, line, static_cast<size_t>(length)) != length || read(in, line, sizeof line) <= 0) return 0;
    }
}

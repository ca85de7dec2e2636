/* Fuzzes what comes in on the serial line: parser, commands, gate and interpolator, under the sanitizers.
 *
 * LLVMFuzzerTestOneInput is libFuzzer's entry. Without clang, main() below does the same with gcc: inputs are mutated from
 * a corpus, and one that reaches new code (trace-pc) is kept. An input is a list of actions: raw bytes, whole frames with a
 * right check sum, time going by, switches.
 */
#include <dirent.h>
#include <signal.h>
#include <unistd.h>

#include "bench.h"

#define MAX_INPUT 512U
#define MAX_KEPT 4096U

static const uint8_t IDS[] = {FRAME_HELLO, FRAME_CONFIGURE, FRAME_ARM, FRAME_DISARM, FRAME_CLEAR_FAULT,
                              FRAME_SETPOINT, FRAME_SET_POSITION, FRAME_PING};
static const uint8_t BYTES[] = {FRAME_HELLO_BYTES, FRAME_CONFIGURE_BYTES, FRAME_ARM_BYTES, FRAME_DISARM_BYTES,
                                FRAME_CLEAR_FAULT_BYTES, FRAME_SETPOINT_BYTES, FRAME_SET_POSITION_BYTES, FRAME_PING_BYTES};

static void one_tick(void) {
    uint8_t state = safety.state;
    int32_t before[AXIS_COUNT];
    for (unsigned axis = 0; axis < AXIS_COUNT; axis++) before[axis] = motion_position((uint8_t)axis);
    uint8_t out = controller_tick(bench.encoder_bits);
    for (unsigned axis = 0; axis < AXIS_COUNT; axis++) {
        int32_t step = motion_position((uint8_t)axis) - before[axis];
        CHECK_EQUAL(step != 0, out >> axis & 1U);
        CHECK(step == 0 || state == STATE_RUNNING || state == STATE_STOPPING);
        if (step) CHECK_EQUAL(step, out >> (OUTPUT_DIRECTION_SHIFT + axis) & 1U ? -1 : 1);
    }
    while (controller_poll()) {}
    uint8_t byte;
    while (link_next_byte(&byte)) {}
}

static void give(const uint8_t *bytes, unsigned n) {
    for (unsigned i = 0; i < n; i++) {
        link_receive(bytes[i], false);
        if (i % 4 == 3) one_tick(); /* 40 us a byte, 50 us a tick */
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    memset(&bench, 0, sizeof bench);
    bring_up();
    for (size_t at = 0; at < size;) {
        uint8_t action = data[at++], left = (uint8_t)(size - at > 255 ? 255 : size - at), n = action >> 2;
        if (n > left) n = left;
        uint8_t payload[256] = {0}, frame[FRAME_MAX_WIRE_BYTES];
        unsigned which = n % sizeof IDS, bytes = BYTES[which] < left ? BYTES[which] : left;
        switch (action & 3U) {
            case 0: give(data + at, n); at += n; break;
            case 1:
                memcpy(payload, data + at, bytes);
                at += bytes;
                uint8_t sequence = IDS[which] == FRAME_SETPOINT ? ++bench.setpoint_sequence : ++bench.command_sequence;
                give(frame, make_frame(frame, IDS[which], sequence, payload, BYTES[which]));
                break;
            case 2: for (unsigned i = 0; i <= n; i++) one_tick(); break;
            default: bench.switches = left ? data[at++] & 0x7F : 0; break;
        }
    }
    return 0;
}

#ifndef LIBFUZZER
static uint8_t seen[1U << 16];
static unsigned news;

/* Called by the compiler's instrumentation at each edge of the code under test. */
void __sanitizer_cov_trace_pc(void);
__attribute__((no_sanitize_address, no_sanitize_undefined)) void __sanitizer_cov_trace_pc(void) {
    static uintptr_t last;
    uintptr_t here = (uintptr_t)__builtin_return_address(0);
    unsigned slot = (unsigned)((here >> 1 ^ last) & 0xFFFFU);
    last = here >> 2;
    if (!seen[slot]) {
        seen[slot] = 1;
        news++;
    }
}

static struct { uint8_t bytes[MAX_INPUT]; unsigned n; } kept[MAX_KEPT];
static unsigned kept_count;
static uint8_t trial[MAX_INPUT];
static unsigned trial_n;

static void save(const char *folder, const char *name, const uint8_t *bytes, unsigned n) {
    char path[512];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE *file = fopen(path, "wb");
    if (!file) return;
    fwrite(bytes, 1, n, file);
    fclose(file);
}

static void on_crash(int number) {
    (void)number;
    save(".", "crash-input", trial, trial_n);
    _exit(77);
}

static void load(const char *folder) {
    DIR *directory = opendir(folder);
    for (struct dirent *entry; directory && (entry = readdir(directory)) != NULL && kept_count < MAX_KEPT;) {
        char path[512];
        snprintf(path, sizeof path, "%s/%s", folder, entry->d_name);
        FILE *file = entry->d_name[0] == '.' ? NULL : fopen(path, "rb");
        if (!file) continue;
        kept[kept_count].n = (unsigned)fread(kept[kept_count].bytes, 1, MAX_INPUT, file);
        fclose(file);
        LLVMFuzzerTestOneInput(kept[kept_count].bytes, kept[kept_count].n);
        kept_count++;
    }
    if (directory) closedir(directory);
}

static void mutate(void) {
    unsigned parent = kept_count ? random_u32() % kept_count : 0;
    trial_n = kept_count ? kept[parent].n : 0;
    memcpy(trial, kept[parent].bytes, trial_n);
    for (unsigned times = 1 + random_u32() % 6; times; times--) {
        unsigned at = trial_n ? random_u32() % trial_n : 0;
        switch (random_u32() % 6) {
            case 0: if (trial_n) trial[at] ^= (uint8_t)(1U << random_u32() % 8); break;
            case 1: if (trial_n) trial[at] = (uint8_t)random_u32(); break;
            case 2: if (trial_n) trial[at] = (uint8_t)((random_u32() & 1) ? 0xFF : 0x00); break;
            case 3: if (trial_n > 1) memmove(trial + at, trial + at + 1, --trial_n - at); break;
            case 4:
                for (unsigned n = 1 + random_u32() % 24; n && trial_n < MAX_INPUT; n--) trial[trial_n++] = (uint8_t)random_u32();
                break;
            default: { /* the tail of another */
                if (!kept_count) break;
                unsigned other = random_u32() % kept_count, from = kept[other].n ? random_u32() % kept[other].n : 0;
                for (; from < kept[other].n && trial_n < MAX_INPUT; from++) trial[trial_n++] = kept[other].bytes[from];
            }
        }
    }
    if (trial_n > 160) trial_n = 160; /* short inputs say as much and are faster */
}

/* fuzz_link CORPUS INPUTS: exit status 0 after INPUTS inputs without a finding. */
int main(int argc, char **argv) {
    if (argc != 3) return fprintf(stderr, "usage: %s CORPUS INPUTS\n", argv[0]), 2;
    signal(SIGABRT, on_crash);
    unsigned long long wanted = strtoull(argv[2], NULL, 10);
    load(argv[1]);
    unsigned loaded = kept_count, edges = news;
    for (unsigned long long i = 0; i < wanted; i++) {
        mutate();
        unsigned before = news;
        LLVMFuzzerTestOneInput(trial, trial_n);
        if (news == before || kept_count == MAX_KEPT) continue;
        memcpy(kept[kept_count].bytes, trial, trial_n);
        kept[kept_count++].n = trial_n;
        char name[32];
        uint32_t hash = 2166136261U;
        for (unsigned j = 0; j < trial_n; j++) hash = (hash ^ trial[j]) * 16777619U;
        snprintf(name, sizeof name, "%08x", hash);
        save(argv[1], name, trial, trial_n);
    }
    printf("{\"inputs\": %llu, \"edges_before\": %u, \"edges\": %u, \"corpus\": %u, \"new_in_corpus\": %u, \"findings\": 0}\n",
           wanted, edges, news, kept_count, kept_count - loaded);
    return 0;
}
#endif

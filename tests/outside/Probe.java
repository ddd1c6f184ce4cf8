import java.io.FileWriter;
import java.math.BigDecimal;
import java.math.BigInteger;
import java.util.ArrayList;
import java.util.Arrays;
import java.util.List;
import java.util.Map;
import java.util.concurrent.atomic.AtomicLong;
import java.util.function.Function;
import simenv.SimEnv;

/** A model that does what an option of the episode names, one way for each test. */
public final class Probe {
    enum Mood { GLAD }

    static long seeded;

    public static void main(String[] arguments) throws Exception {
        System.out.println("standard output is the model's");
        boolean plain = arguments.length > 0;
        if (SimEnv.inside() == plain) {
            throw new IllegalStateException("it should know where it is");
        }
        System.out.println(SimEnv.decideInt("a", null, a -> {}, () -> 4)); // no episode yet: its rule
        if (!plain && System.getenv("PROBE_CANNOT_RESEED") != null) {
            SimEnv.run(List.of("a"), Probe::episode);
        } else {
            SimEnv.run(List.of("a", "b"), Probe::episode, Probe::reseed);
        }
        System.out.println(SimEnv.json(episode(7, Map.of("do", arguments[0]))));
    }

    static void reseed(long seed) {
        if (seed < 0) {
            throw new IllegalStateException("no such seed");
        }
        seeded = seed + SimEnv.decideLong("a", null, a -> {}, () -> 1000); // within an exchange: its rule
    }

    static Object any(Object value) {
        return SimEnv.decide("a", "x", a -> a.put("value", value), () -> "rule", Function.identity());
    }

    static Object episode(long seed, Map<String, Object> options) throws Exception {
        seeded = seed;
        switch (String.valueOf(options.get("do"))) {
            case "count":
                double sum = 0;
                for (int i = 0; i < 5; i++) {
                    int now = i;
                    sum += SimEnv.decideDouble(
                            "a", "x", a -> a.time(now).put("i", now).put("half", now / 2.0), () -> 0.1 * now);
                }
                return new SimEnv.End(Map.of("sum", sum, "seed", seeded), true);
            case "echo":
                return any(options.get("value"));
            case "java":
                BigInteger big = new BigInteger("123456789012345678901234567890");
                return any(new Object[] {
                    new int[] {1, 2}, new double[] {0.5, Double.NaN}, new boolean[0], Mood.GLAD, 'c', 1.5f, (byte) 3,
                    List.of(Map.of(1, "one")), new AtomicLong(7), new BigDecimal("0.5"), big, null
                });
            case "typed":
                List<Object> found = new ArrayList<>();
                found.add(SimEnv.decideDouble("a", null, a -> {}, () -> 0.25));
                found.add(SimEnv.decideLong("a", null, a -> {}, () -> 3L));
                found.add(SimEnv.decideInt("a", null, a -> {}, () -> 2));
                found.add(SimEnv.decideBoolean("a", null, a -> {}, () -> false));
                found.add(SimEnv.decide("a", null, a -> {}, () -> Mood.GLAD, value -> Mood.valueOf((String) value)));
                return found;
            case "nested":
                return SimEnv.decideInt("a", "x", a -> {}, () -> 10 * SimEnv.decideInt("b", "y", b -> {}, () -> 1));
            case "in arguments":
                return SimEnv.decideInt(
                        "a", "x", a -> a.put("n", SimEnv.decideInt("b", "y", b -> b.put("m", 1), () -> 5)), () -> 1);
            case "removals":
                any(1);
                SimEnv.remove("a", "x");
                SimEnv.update("a", "y", a -> a.time(3).put("level", 0.5).put("full", true).put("mark", 'm'));
                SimEnv.update("a", null, a -> {});
                SimEnv.remove("a", "y");
                return null;
            case "swallows":
                return swallows((String) options.get("file"));
            case "throws":
                any(0);
                throw new java.io.IOException("the mill \u2603 burnt down");
            case "silent throw":
                throw new RuntimeException((String) null);
            case "overflow":
                return overflow(0);
            case "bad arguments":
                return guarded(new Object());
            case "bad update":
                try {
                    SimEnv.update("a", "x", a -> a.put("value", new Object()));
                } catch (Exception error) {
                    return "swallowed";
                }
                return null;
            case "too much":
                return guarded("x".repeat(16 << 20));
            case "long line":
                return any("x".repeat((16 << 20) - 100));
            case "bad result":
                return new Object();
            case "bad decision":
                try {
                    return typed((String) options.get("type"));
                } catch (Exception error) {
                    return "swallowed";
                }
            case "threads":
                return threads();
            case "exits":
                any(0);
                System.exit(3);
                return null;
            case "refuses":
                while (true) {
                    try {
                        any(0);
                    } catch (SimEnv.Stop stop) {
                        Thread.sleep(10);
                    }
                }
            default:
                throw new IllegalArgumentException("do what?");
        }
    }

    static Object typed(String type) {
        return switch (type) {
            case "double" -> SimEnv.decideDouble("a", "x", a -> {}, () -> 1);
            case "long" -> SimEnv.decideLong("a", "x", a -> {}, () -> 1);
            case "int" -> SimEnv.decideInt("a", "x", a -> {}, () -> 1);
            case "boolean" -> SimEnv.decideBoolean("a", "x", a -> {}, () -> true);
            default -> SimEnv.decide("a", "x", a -> {}, () -> Mood.GLAD, value -> Mood.valueOf((String) value));
        };
    }

    static Object guarded(Object value) {
        try {
            return any(value);
        } catch (Exception error) {
            return "swallowed";
        }
    }

    static int overflow(int depth) {
        SimEnv.decideInt("a", "x", a -> {}, () -> 1);
        return 1 + overflow(depth + 1);
    }

    /** Catches each exception, decides again on its way out, and writes down what it has seen. */
    static Object swallows(String file) throws Exception {
        List<String> seen = new ArrayList<>();
        for (int i = 0; i < 3; i++) {
            try {
                seen.add("answer " + any(i));
            } catch (Exception error) {
                seen.add("exception");
            } finally {
                try {
                    any("finally");
                } catch (Throwable stop) {
                    seen.add(stop.getClass().getSimpleName());
                }
                SimEnv.update("a", "x", a -> a.put("i", 1));
                SimEnv.remove("a", "x");
                try (FileWriter out = new FileWriter(file)) {
                    out.write(String.join("\n", seen));
                }
            }
        }
        return seen;
    }

    static Object threads() throws Exception {
        int[] sums = new int[4];
        Thread[] workers = new Thread[sums.length];
        for (int n = 0; n < workers.length; n++) {
            int number = n;
            workers[n] = new Thread(() -> {
                for (int i = 0; i < 50; i++) {
                    sums[number] += SimEnv.decideInt("a", "w" + number, a -> a.put("n", number), () -> number);
                }
            });
            workers[n].start();
        }
        for (Thread worker : workers) {
            worker.join();
        }
        return Arrays.stream(sums).boxed().toList();
    }
}

import java.math.BigDecimal;
import java.math.BigInteger;
import java.util.ArrayList;
import java.util.Arrays;
import java.util.List;
import java.util.Map;
import java.util.concurrent.atomic.AtomicLong;
import java.util.function.Function;
import simenv.SimEnv;

/** Plays what the option "play" names; probe.cpp plays the same in C++. */
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
        SimEnv.reportRules(System.getenv("NESTED") == null);
        SimEnv.run(List.of("a", "b"), Probe::episode, Probe::reseed);
        System.out.println(SimEnv.json(episode(7, Map.of("play", arguments[0]))));
    }

    static void reseed(long seed) {
        seeded = seed + SimEnv.decideLong("a", null, a -> {}, () -> 1000); // within an exchange: its rule
    }

    static Object any(Object value) {
        return SimEnv.decide("a", "x", a -> a.put("value", value), () -> "rule", Function.identity());
    }

    static Object episode(long seed, Map<String, Object> options) throws Exception {
        int times = ((Number) options.getOrDefault("times", 5)).intValue();
        switch (String.valueOf(options.getOrDefault("play", "echo"))) {
            case "echo":
                Object value = options.get("value");
                return SimEnv.decide(
                        "a", "ä", a -> a.time(0.25).put("value", value), () -> value, Function.identity());
            case "types":
                try {
                    return types();
                } catch (Exception error) {
                    return "swallowed";
                }
            case "arguments":
                BigInteger big = new BigInteger("123456789012345678901234567890");
                return any(new Object[] {
                    new int[] {1, 2}, new double[] {0.5, Double.NaN}, new boolean[0], Mood.GLAD, 'c', 1.5f, (byte) 3,
                    List.of(Map.of(1, "one")), new AtomicLong(7), new BigDecimal("0.5"), big, null
                });
            case "reports":
                SimEnv.remove("a", "x");
                SimEnv.update("a", "y", a -> a.time(3).put("level", 0.5).put("full", true).put("mark", 'm'));
                SimEnv.update("a", null, a -> {});
                SimEnv.remove("a", "\"b\"");
                SimEnv.expect("a", "y", a -> a.time(3).put("level", 0.5));
                SimEnv.expect("b", null, a -> {});
                return null;
            case "count":
                return count(times);
            case "deaf":
                return deaf(times);
            case "fail":
                throw new java.io.IOException("the mill \u2603 burnt down");
            case "silent":
                throw new RuntimeException((String) null);
            case "seed":
                return seed;
            case "reseed":
                return SimEnv.decideLong("a", "x", a -> {}, () -> seeded);
            case "nested":
                return SimEnv.decideInt("a", "x", a -> {}, () -> 10 * SimEnv.decideInt("b", "y", b -> {}, () -> 1));
            case "careless":
                return careless();
            case "bad rule":
                return SimEnv.decide("a", "x", a -> {}, Object::new, Function.identity()).hashCode();
            case "bad arguments":
                return guarded(new Object());
            case "bad result":
                return new Object();
            case "huge":
                return guarded("x".repeat(16 << 20));
            case "truncated":
                return new SimEnv.End(Map.of("reached", 3), true);
            case "threads":
                return threads();
            case "leave":
                System.exit(((Number) options.get("status")).intValue());
                return null;
            default:
                return null;
        }
    }

    static Object types() {
        List<Object> found = new ArrayList<>();
        found.add(SimEnv.decideDouble("a", null, a -> {}, () -> 0.25));
        found.add(SimEnv.decideLong("a", null, a -> {}, () -> 3L));
        found.add(SimEnv.decideInt("a", null, a -> {}, () -> 2));
        found.add(SimEnv.decideBoolean("a", null, a -> {}, () -> false));
        found.add(SimEnv.decide("a", null, a -> {}, () -> Mood.GLAD, value -> Mood.valueOf((String) value)));
        return found;
    }

    /** Catches each exception, and decides again on its way out. */
    static Object count(int times) {
        int sum = 0;
        try {
            for (int i = 0; i < times; i++) {
                int now = sum;
                try {
                    sum += SimEnv.decideInt("a", "x", a -> a.put("sum", now), () -> 1);
                } catch (Exception error) {
                    System.err.println("swallowed");
                }
            }
        } finally {
            String last;
            try {
                last = "rule " + SimEnv.decideInt("b", "last", a -> {}, () -> 7);
            } catch (Throwable stop) {
                last = stop.getClass().getSimpleName();
            }
            SimEnv.update("b", "last", a -> a.put("i", 1));
            SimEnv.remove("b", "last");
            System.err.println("unwound by " + last);
        }
        return sum;
    }

    static Object deaf(int times) throws Exception {
        for (int heard = 0; ; ) {
            try {
                any(0);
            } catch (SimEnv.Stop stop) {
                if (++heard == times) {
                    throw stop;
                }
                Thread.sleep(10);
            }
        }
    }

    /** A rule that fails, which the model survives. */
    static Object careless() {
        try {
            SimEnv.decideInt("a", "x", a -> {}, () -> {
                throw new IllegalStateException("no rule");
            });
        } catch (IllegalStateException error) {
            System.err.println("swallowed");
        }
        return SimEnv.decideInt("a", "x", a -> {}, () -> 1);
    }

    static Object guarded(Object value) {
        try {
            return any(value);
        } catch (Exception error) {
            return "swallowed";
        }
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

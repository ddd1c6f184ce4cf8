import java.math.BigDecimal;
import java.math.BigInteger;
import java.util.ArrayList;
import java.util.List;
import java.util.Map;
import java.util.concurrent.Callable;
import java.util.concurrent.atomic.AtomicLong;
import java.util.function.Consumer;
import java.util.function.Function;
import java.util.stream.IntStream;
import simenv.SimEnv;

/** Plays what the option "play" names; probe.cpp plays the same in C++. */
public final class Probe {
    enum Mood { GLAD }

    static long seeded;

    public static void main(String[] arguments) throws Exception {
        boolean plain = arguments.length > 0;
        if (SimEnv.inside() == plain || SimEnv.decideInt("a", null, a -> {}, () -> 4) != 4) {
            throw new IllegalStateException("it should know where it is, and decide by its rule before an episode");
        }
        SimEnv.reportRules(System.getenv("NESTED") == null);
        SimEnv.run(List.of("a", "b"), Probe::episode, Probe::reseed);
        System.out.println(SimEnv.json(episode(7, Map.of("play", arguments[0]))));
    }

    static void reseed(long seed) {
        seeded = seed + SimEnv.decideLong("a", null, a -> {}, () -> 1000); // within an exchange: its rule
    }

    static Object any(Consumer<SimEnv.Arguments> arguments) {
        return SimEnv.decide("a", "x", arguments, () -> "rule", Function.identity());
    }

    static Object episode(long seed, Map<String, Object> options) throws Exception {
        Object value = options.get("value");
        return switch (String.valueOf(options.getOrDefault("play", "echo"))) {
            case "echo" -> SimEnv.decide(
                    "a", "ä", a -> a.time(0.25).put("value", value), () -> value, Function.identity());
            case "types" -> guarded(Probe::types);
            case "arguments" -> arguments();
            case "reports" -> reports();
            case "count" -> count();
            case "deaf" -> deaf();
            case "fail" -> throw new java.io.IOException("the pump is broken \u2603");
            case "silent" -> throw new RuntimeException((String) null);
            case "seed" -> seed;
            case "reseed" -> SimEnv.decideLong("a", "x", a -> {}, () -> seeded);
            case "nested" -> SimEnv.decideInt(
                    "a", "x", a -> {}, () -> 10 * SimEnv.decideInt("b", "y", b -> {}, () -> 1));
            case "careless" -> careless();
            case "bad rule" -> SimEnv.decide("a", "x", a -> {}, Object::new, Function.identity()).hashCode();
            case "bad arguments" -> guarded(() -> any(a -> a.put("value", new Object())));
            case "bad result" -> new Object();
            case "huge" -> guarded(() -> any(a -> a.put("value", "x".repeat(16 << 20))));
            case "truncated" -> new SimEnv.End(Map.of("reached", 3), true);
            case "threads" -> threads();
            case "late_threads" -> IntStream.range(0, 2).parallel().map(Probe::late).sum();
            case "leave" -> {
                System.exit(((Number) options.get("status")).intValue());
                yield null;
            }
            default -> null;
        };
    }

    /** Catches what a model may catch. */
    static Object guarded(Callable<Object> play) {
        try {
            return play.call();
        } catch (Exception error) {
            return "swallowed";
        }
    }

    static Object arguments() {
        BigInteger big = new BigInteger("123456789012345678901234567890");
        Object[] objects = {
            new int[] {1, 2}, new double[] {0.5, Double.NaN}, new boolean[0], Mood.GLAD, 'c', 1.5f, (byte) 3,
            List.of(Map.of(1, "one")), new AtomicLong(7), new BigDecimal("0.5"), big, null
        };
        return any(a -> a.put("value", objects).put("full", true).put("mark", 'm'));
    }

    static Object reports() {
        SimEnv.update("a", "12", a -> a.time(1.5).put("level", 0.5));
        SimEnv.remove("a", "12");
        SimEnv.remove("a", "\"b\"");
        SimEnv.update("a", null, a -> a.put("level", 1));
        SimEnv.expect("a", "12", a -> a.time(1.5).put("level", 0.5));
        SimEnv.expect("b", null, a -> {});
        return null;
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
    static Object count() {
        int sum = 0;
        try {
            for (int i = 0; i < 5; i++) {
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

    static Object deaf() throws Exception {
        while (true) {
            try {
                any(a -> {});
            } catch (SimEnv.Stop stop) {
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
            // as if nothing had happened
        }
        return SimEnv.decideInt("a", "x", a -> {}, () -> 1);
    }

    static Object threads() {
        return IntStream.range(0, 4).parallel().map(Probe::sum).boxed().toList();
    }

    static int late(int n) {
        try {
            Thread.sleep(Thread.currentThread().getName().equals("main") ? 0 : 200);
        } catch (InterruptedException error) {
            throw new IllegalStateException(error);
        }
        return sum(n);
    }

    static int sum(int n) {
        return IntStream.range(0, 50).map(i -> SimEnv.decideInt("a", "w" + n, a -> a.put("n", n), () -> n)).sum();
    }
}

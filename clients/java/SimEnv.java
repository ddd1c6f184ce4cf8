package simenv;

import java.io.EOFException;
import java.io.FileInputStream;
import java.io.FileOutputStream;
import java.io.IOException;
import java.io.InputStream;
import java.io.OutputStream;
import java.io.PrintWriter;
import java.io.StringWriter;
import java.lang.reflect.Array;
import java.math.BigInteger;
import java.nio.ByteBuffer;
import java.nio.charset.CharacterCodingException;
import java.nio.charset.StandardCharsets;
import java.util.ArrayList;
import java.util.Arrays;
import java.util.Collections;
import java.util.LinkedHashMap;
import java.util.List;
import java.util.Map;
import java.util.Objects;
import java.util.Set;
import java.util.SplittableRandom;
import java.util.concurrent.ForkJoinPool;
import java.util.concurrent.TimeUnit;
import java.util.concurrent.atomic.AtomicInteger;
import java.util.concurrent.atomic.AtomicLong;
import java.util.function.BooleanSupplier;
import java.util.function.Consumer;
import java.util.function.DoubleSupplier;
import java.util.function.Function;
import java.util.function.IntSupplier;
import java.util.function.LongConsumer;
import java.util.function.LongSupplier;
import java.util.function.Supplier;

/**
 * The client of simenv_marl for models in Java: the model keeps its own main loop, and asks for decisions from anywhere
 * in its code. This file is the whole client. It needs only Java 17; copy it into your sources.
 *
 * <pre>{@code
 * public static void main(String[] arguments) {
 *     if (!SimEnv.run(List.of("shop.price"), (seed, options) -> new Town(seed).live())) {
 *         System.out.println(new Town(Long.parseLong(arguments[0])).live()); // there is no environment
 *     }
 * }
 *
 * // somewhere in the model:
 * double price = SimEnv.decideDouble("shop.price", name, a -> a.time(day).put("stock", stock), () -> 1.2 * cost);
 * }</pre>
 *
 * <p>An environment starts the JVM with the numbers of two file descriptors in {@code SIMENV_MARL_FDS}; the model keeps
 * the standard streams. Without that variable, the rule makes every decision; the overhead is one test, and the
 * arguments are not collected.
 *
 * <p>Any thread of the model may ask for decisions, one at a time. Such threads have to end with their episode. If it is
 * stopped or fails, this class waits some seconds for the common pool (parallel streams), but for no other threads.
 */
public final class SimEnv {
    private static final int VERSION = 1;
    private static final int LONGEST_LINE = 16 << 20;
    private static final int LONGEST_TEXT = 1 << 20; // of an error, in characters
    private static final int DEEPEST = 500;
    private static final long SECONDS_TO_LEAVE = 5;
    private static final Object RULE = new Object();
    private static final SimEnv WIRE = connect();
    private static boolean reports = true;

    private final InputStream input;
    private final OutputStream output;
    private final Writer frame = new Writer();
    private final Arguments arguments = new Arguments(frame);
    private byte[] read = new byte[1 << 13];
    private int from;
    private int to;
    private LongConsumer reseed;
    private long calls;
    private long due; // the call whose rule has not told its decision
    private String ruling; // the point whose rule is running, while its decision is due
    private boolean running; // an episode is in progress
    private boolean stopped; // the episode is being unwound: nothing more is sent
    private boolean busy; // a frame is being written or waits for its answer
    private boolean waiting; // the answer has not arrived yet
    private boolean gone; // the environment has closed the pipes
    private boolean broken; // a protocol error has occurred
    private Throwable fault; // the error of the episode, reported after unwinding

    private SimEnv(String descriptors) throws IOException {
        String[] numbers = descriptors.split(",");
        if (numbers.length != 2) {
            throw new IOException("SIMENV_MARL_FDS has to be two numbers, and is " + descriptors);
        }
        input = new FileInputStream("/dev/fd/" + numbers[0].trim());
        output = new FileOutputStream("/dev/fd/" + numbers[1].trim());
    }

    private static SimEnv connect() {
        String descriptors = System.getenv("SIMENV_MARL_FDS");
        try {
            return descriptors == null ? null : new SimEnv(descriptors);
        } catch (IOException error) {
            throw new IllegalStateException("the environment's pipes cannot be opened: " + error.getMessage(), error);
        }
    }

    // -- episodes --------------------------------------------------------------------------------------------------

    /** One episode of the model: its own main loop. */
    @FunctionalInterface
    public interface Episode {
        /**
         * Runs the episode to its end.
         *
         * @param seed the seed of the model's generators; random if the environment gives none
         * @param options the options of the environment's reset, as maps, lists, strings, booleans, longs and doubles
         * @return the result: anything that {@link Arguments#put(String, Object)} takes, or an {@link End}
         * @throws Exception any exception; it becomes an error in the environment
         */
        Object run(long seed, Map<String, Object> options) throws Exception;
    }

    /**
     * The result of an episode, and whether it ended by a time limit and not by the end of the task.
     *
     * @param result the result
     * @param truncated whether it ended by a time limit
     */
    public record End(Object result, boolean truncated) {}

    /** Thrown by decisions to unwind an episode that has been stopped. Do not catch it; {@code finally} blocks run. */
    @SuppressWarnings("serial")
    public static final class Stop extends Error {
        private Stop() {
            super("the environment has stopped this episode", null, false, false);
        }
    }

    /** Whether an environment has started this JVM. */
    public static boolean inside() {
        return WIRE != null;
    }

    /**
     * Sets whether the environment is told what rules decide, as it is by default. Rules that ask for other decisions,
     * or whose decisions cannot be sent, need false. Call it before {@code run}.
     */
    public static void reportRules(boolean report) {
        reports = report;
    }

    /** As {@link #run(List, Episode, LongConsumer)}, for a model that cannot be reseeded during an episode. */
    public static boolean run(List<String> points, Episode episode) {
        return run(points, episode, null);
    }

    /**
     * Runs the episodes that the environment requests, until it closes the pipes, and then exits the JVM.
     *
     * @param points the names of all decision points
     * @param episode one episode of the model
     * @param reseed reseeds the generators of the running episode, for another future; null: the model cannot do so
     * @return false, immediately, if there is no environment
     */
    public static boolean run(List<String> points, Episode episode, LongConsumer reseed) {
        if (WIRE != null) {
            WIRE.serve(points, episode, reseed);
        }
        return false;
    }

    private void serve(List<String> points, Episode episode, LongConsumer callback) {
        reseed = callback;
        try {
            frame.begin().key("hello").number(VERSION).key("points").value(points);
            List<String> can = new ArrayList<>(List.of("expect"));
            if (reports) {
                can.add("decided");
            }
            if (callback != null) {
                can.add("reseed");
            }
            send(frame.key("can").value(can).close());
            while (!gone && !broken) {
                Map<?, ?> start = start();
                if (start != null) {
                    play(episode, start);
                }
                if (fault != null) {
                    tell(fault);
                }
            }
        } catch (IOException error) {
            leave();
        }
        System.exit(broken ? 1 : 0);
    }

    private Map<?, ?> start() throws IOException {
        fault = null;
        try {
            Map<?, ?> told = receive();
            if (told.get("start") instanceof Map<?, ?> start) {
                return start;
            }
            if (!told.containsKey("stop")) { // of an episode that has ended meanwhile
                throw new WireError("a start was expected, and this came: " + json(told));
            }
        } catch (WireError error) {
            broken = true;
            fault = error;
        }
        return null;
    }

    private void play(Episode episode, Map<?, ?> start) {
        admit();
        Object result = null;
        Throwable error = null;
        try {
            Object seed = start.get("seed");
            long seeded = seed == null ? new SplittableRandom().nextLong() : seed(seed);
            result = episode.run(seeded, options(start.get("options")));
        } catch (Throwable thrown) {
            error = thrown;
            // because a parallel stream that fails in one thread leaves others, which would ask in the next episode
            ForkJoinPool.commonPool().awaitQuiescence(SECONDS_TO_LEAVE, TimeUnit.SECONDS);
        }
        finish(result, error);
    }

    private synchronized void admit() {
        calls = 0;
        due = 0;
        running = true;
    }

    private synchronized void finish(Object result, Throwable error) {
        if (!stopped) { // else the error is the Stop, or what has become of it
            fault = error;
            try {
                if (error == null) {
                    if (due != 0) {
                        tellDecided(null);
                    }
                    Object end = result instanceof End ? result : new End(result, false);
                    send(frame.begin().key("end").value(end).close());
                }
            } catch (Throwable thrown) {
                fault = thrown;
            }
        }
        running = false;
        stopped = gone;
    }

    private static long seed(Object value) {
        if (value instanceof Long seed) {
            return seed;
        }
        throw new IllegalArgumentException("a seed has to be an integer of 64 bits, and is " + json(value));
    }

    @SuppressWarnings("unchecked")
    private static Map<String, Object> options(Object value) {
        return value == null ? Map.of() : (Map<String, Object>) value;
    }

    // -- decisions -------------------------------------------------------------------------------------------------

    /**
     * Asks for a decision, or runs the rule if there is no environment or if the environment chooses the rule.
     *
     * @param point the name of the decision point
     * @param entity the name of the entity that decides; null if there is only one
     * @param arguments collects the arguments of the decision
     * @param rule the model's own rule
     * @param taken converts the answer, a string, boolean, long, double, list, map or null, to a decision
     * @return the decision
     */
    public static <T> T decide(
            String point, String entity, Consumer<Arguments> arguments, Supplier<T> rule, Function<Object, T> taken) {
        Objects.requireNonNull(taken);
        @SuppressWarnings("unchecked")
        T decided = WIRE == null ? rule.get() : (T) WIRE.ask(point, entity, arguments, rule, taken);
        return decided;
    }

    /** As {@link #decide}, for a double; integers become doubles. */
    public static double decideDouble(String point, String entity, Consumer<Arguments> arguments, DoubleSupplier rule) {
        if (WIRE == null) {
            return rule.getAsDouble();
        }
        return (Double) WIRE.ask(point, entity, arguments, rule::getAsDouble, value -> ((Number) value).doubleValue());
    }

    /** As {@link #decide}, for a long. */
    public static long decideLong(String point, String entity, Consumer<Arguments> arguments, LongSupplier rule) {
        if (WIRE == null) {
            return rule.getAsLong();
        }
        return (Long) WIRE.ask(point, entity, arguments, rule::getAsLong, value -> ((Long) value).longValue());
    }

    /** As {@link #decide}, for an int. */
    public static int decideInt(String point, String entity, Consumer<Arguments> arguments, IntSupplier rule) {
        if (WIRE == null) {
            return rule.getAsInt();
        }
        return (Integer) WIRE.ask(point, entity, arguments, rule::getAsInt, value -> Math.toIntExact((Long) value));
    }

    /** As {@link #decide}, for a boolean. */
    public static boolean decideBoolean(
            String point, String entity, Consumer<Arguments> arguments, BooleanSupplier rule) {
        if (WIRE == null) {
            return rule.getAsBoolean();
        }
        return (Boolean) WIRE.ask(point, entity, arguments, rule::getAsBoolean, value -> ((Boolean) value).booleanValue());
    }

    /**
     * Reports the current arguments of an entity. Call it before the entity is removed and before the episode ends, so
     * that its last reward and observation refer to this moment and not to its last decision.
     *
     * @param point the name of its decision point
     * @param entity the name of the entity; null if there is only one
     * @param arguments collects the arguments, as in a decision
     */
    public static void update(String point, String entity, Consumer<Arguments> arguments) {
        if (WIRE != null) {
            WIRE.call("update", point, entity, arguments, null);
        }
    }

    /**
     * Reports that an entity is going to decide, with the arguments that it has now. So agents that are born together
     * act in one round of the parallel view. Call it for all of them before the first of them decides.
     *
     * @param point the name of its decision point
     * @param entity the name of the entity; null if there is only one
     * @param arguments collects the arguments, as in a decision
     */
    public static void expect(String point, String entity, Consumer<Arguments> arguments) {
        if (WIRE != null) {
            WIRE.call("expect", point, entity, arguments, null);
        }
    }

    /**
     * Reports that an entity is gone and makes no more decisions.
     *
     * @param point the name of its decision point
     * @param entity the name of the entity
     */
    public static void remove(String point, String entity) {
        if (WIRE != null) {
            WIRE.call("remove", point, entity, null, null);
        }
    }

    /** Gets a decision from the environment or the rule; if the latter is to be told, no other frame comes before. */
    private Object ask(
            String point, String entity, Consumer<Arguments> arguing, Supplier<?> rule, Function<Object, ?> taken) {
        synchronized (this) {
            Object answer = call("decide", point, entity, arguing, taken);
            if (answer != RULE) {
                return answer;
            }
            if (due != 0) {
                ruling = point;
                try {
                    answer = rule.get();
                } finally {
                    ruling = null;
                }
                tellDecided(answer);
                return answer;
            }
        }
        return rule.get();
    }

    private void tellDecided(Object value) {
        try {
            send(frame.begin().key("decided").number(due).key("value").value(value).close());
            due = 0;
        } catch (IOException error) {
            throw leave();
        } catch (RuntimeException error) {
            String text = "the rule's decision of call " + due + " cannot be sent: " + error.getMessage();
            throw fail(new IllegalArgumentException(text + "; SimEnv.reportRules(false) spares that", error));
        }
    }

    /** Unwinds the model because of an error that it cannot catch. */
    private Stop fail(Throwable error) {
        fault = error;
        stopped = true;
        return new Stop();
    }

    /** Sends a decision and waits for its answer, or sends a report about an entity, which has no answer. */
    private synchronized Object call(
            String what, String point, String entity, Consumer<Arguments> arguing, Function<Object, ?> taken) {
        boolean asks = taken != null;
        if (!running || busy || stopped && !asks) {
            return RULE;
        }
        if (stopped) {
            throw new Stop();
        }
        if (ruling != null) {
            throw fail(new IllegalStateException("the rule of " + ruling + " has asked for a decision, or reported on an"
                    + " entity; it must only decide, or call SimEnv.reportRules(false) before"));
        }
        if (due != 0) { // the rule has thrown an exception, which the model has caught
            tellDecided(null);
        }
        busy = true;
        try {
            frame.begin().key(what);
            boolean expects = what.equals("expect");
            if (expects) {
                frame.put('[').open().key("entity");
            }
            if (!asks) {
                frame.value(entity);
            } else if (entity == null) {
                frame.number(++calls);
            } else {
                frame.number(++calls).key("entity").value(entity);
            }
            frame.key("point").value(point);
            if (arguing != null) {
                argue(arguing);
            }
            if (expects) {
                frame.close().put(']');
            }
            send(frame.close());
            waiting = asks;
            Object answer = asks ? answer() : RULE;
            if (fault == null) {
                return answer == RULE ? RULE : take(point, answer, taken);
            }
        } catch (Stop stop) {
            throw stop;
        } catch (IOException error) {
            throw leave();
        } catch (Throwable error) {
            fault = error;
            broken = waiting;
        } finally {
            busy = false;
            waiting = false;
        }
        stopped = true;
        throw new Stop();
    }

    private Object answer() throws IOException {
        while (true) {
            Map<?, ?> told = receive();
            if (told.containsKey("stop")) {
                stopped = true;
                throw new Stop();
            }
            if (told.containsKey("reseed") && reseed != null) {
                try {
                    reseed.accept(seed(told.get("reseed")));
                } catch (RuntimeException error) {
                    fault = error; // the answer arrives nevertheless
                }
                continue;
            }
            boolean rule = Boolean.TRUE.equals(told.get("rule"));
            if (!told.containsKey("act") || !rule && !told.containsKey("value")) {
                throw new WireError("an answer to call " + calls + " was expected, and this came: " + json(told));
            }
            if (!Long.valueOf(calls).equals(told.get("act"))) {
                throw new WireError("call " + calls + " waits for its answer, and this came: " + json(told));
            }
            waiting = false;
            due = rule && reports ? calls : 0;
            return rule ? RULE : told.get("value");
        }
    }

    private static Object take(String point, Object value, Function<Object, ?> taken) {
        try {
            return taken.apply(value);
        } catch (RuntimeException error) {
            throw new IllegalArgumentException(point + " cannot take the decision " + json(value), error);
        }
    }

    private void argue(Consumer<Arguments> arguing) {
        arguments.time = Double.NaN;
        frame.key("args").open();
        arguing.accept(arguments);
        frame.close();
        if (!Double.isNaN(arguments.time)) {
            frame.key("time").number(arguments.time);
        }
    }

    // -- faults ----------------------------------------------------------------------------------------------------

    /** A protocol error: the client does not understand the environment from here on. */
    @SuppressWarnings("serial")
    private static final class WireError extends RuntimeException {
        WireError(String text) {
            super(text);
        }
    }

    private void tell(Throwable error) throws IOException {
        StringWriter trace = new StringWriter();
        error.printStackTrace(new PrintWriter(trace, true));
        frame.begin().key("error").open().key("type").value(error.getClass().getName());
        frame.key("text").value(cut(Objects.requireNonNullElse(error.getMessage(), "")));
        send(frame.key("trace").value(cut(trace.toString())).close().close());
    }

    private static String cut(String text) {
        return text.length() > LONGEST_TEXT ? text.substring(0, LONGEST_TEXT) : text;
    }

    /** The environment is gone: unwinds the episode, and exits the JVM if the model does not end. */
    private Stop leave() {
        if (!gone) {
            Thread end = new Thread(SimEnv::halt, "simenv-leave");
            end.setDaemon(true);
            end.start();
        }
        gone = true;
        stopped = true;
        return new Stop();
    }

    private static void halt() {
        try {
            Thread.sleep(1000 * SECONDS_TO_LEAVE);
        } catch (InterruptedException hurried) {
            Thread.currentThread().interrupt();
        }
        Runtime.getRuntime().halt(1);
    }

    // -- lines -----------------------------------------------------------------------------------------------------

    private void send(Writer line) throws IOException {
        if (line.length >= LONGEST_LINE) {
            throw new IllegalArgumentException(line.length + " bytes are to be sent, and 16 MiB is the most");
        }
        line.put('\n');
        output.write(line.bytes, 0, line.length);
    }

    private Map<?, ?> receive() throws IOException {
        int end = from;
        while (true) {
            for (; end < to; end++) {
                if (read[end] == '\n') {
                    int begin = from;
                    from = end + 1;
                    return new Reader(read, begin, end).frame();
                }
            }
            if (end - from >= LONGEST_LINE) {
                throw new WireError("a line has more than 16 MiB");
            }
            System.arraycopy(read, from, read, 0, to - from);
            end -= from;
            to -= from;
            from = 0;
            if (to == read.length) {
                read = Arrays.copyOf(read, 2 * to);
            }
            int count = input.read(read, to, read.length - to);
            if (count < 0) {
                throw new EOFException();
            }
            to += count;
        }
    }

    // -- JSON ------------------------------------------------------------------------------------------------------

    /** The arguments of a decision. */
    public static final class Arguments {
        private final Writer writer;
        private double time;

        private Arguments(Writer writer) {
            this.writer = writer;
        }

        /** Sets the model's time. */
        public Arguments time(double now) {
            time = now;
            return this;
        }

        public Arguments put(String name, double value) {
            writer.key(name).number(value);
            return this;
        }

        public Arguments put(String name, long value) {
            writer.key(name).number(value);
            return this;
        }

        public Arguments put(String name, boolean value) {
            writer.key(name).value(value);
            return this;
        }

        public Arguments put(String name, char value) {
            return put(name, (Object) value);
        }

        /** Adds a string, number, boolean, enum (its name), array, iterable or map of such, or null. */
        public Arguments put(String name, Object value) {
            writer.key(name).value(value);
            return this;
        }
    }

    /**
     * Writes a value as the environment gets it, in one line of JSON: to compare runs without an environment.
     *
     * @param value a string, number, boolean, enum, array, iterable or map of such, null, or an {@link End}
     */
    public static String json(Object value) {
        Writer writer = new Writer();
        writer.value(value);
        return new String(writer.bytes, 0, writer.length, StandardCharsets.UTF_8);
    }

    private static final class Writer {
        private static final Set<Class<?>> WHOLE =
                Set.of(Long.class, Integer.class, Short.class, Byte.class, AtomicInteger.class, AtomicLong.class);
        private byte[] bytes = new byte[1 << 10];
        private int length;
        private boolean first;

        /** Begins a frame, and discards an unfinished one. */
        Writer begin() {
            length = 0;
            return open();
        }

        Writer open() {
            first = true;
            return put('{');
        }

        Writer close() {
            first = false;
            return put('}');
        }

        Writer key(String name) {
            if (!first) {
                put(',');
            }
            first = false;
            return string(name).put(':');
        }

        Writer number(long value) {
            return ascii(Long.toString(value));
        }

        Writer number(double value) {
            if (Double.isFinite(value)) {
                return ascii(Double.toString(value));
            }
            return ascii("{\"float\":\"").ascii(Double.isNaN(value) ? "nan" : value > 0 ? "inf" : "-inf").ascii("\"}");
        }

        Writer value(Object value) {
            if (value == null || value instanceof Boolean || value instanceof BigInteger) {
                return ascii(String.valueOf(value));
            } else if (WHOLE.contains(value.getClass())) {
                return number(((Number) value).longValue());
            } else if (value instanceof Number number) {
                return number(number.doubleValue());
            } else if (value instanceof Enum<?> constant) {
                return string(constant.name());
            } else if (value instanceof CharSequence || value instanceof Character) {
                return string(value.toString());
            } else if (value instanceof Map<?, ?> map) {
                return map(map);
            } else if (value instanceof End end) {
                return open().key("truncated").value(end.truncated).key("result").value(end.result).close();
            } else if (value instanceof Iterable<?> values) {
                put('[');
                String comma = "";
                for (Object each : values) {
                    ascii(comma).value(each);
                    comma = ",";
                }
                return put(']');
            } else if (value.getClass().isArray()) {
                put('[');
                for (int i = 0; i < Array.getLength(value); i++) {
                    ascii(i == 0 ? "" : ",").value(Array.get(value, i));
                }
                return put(']');
            }
            throw new IllegalArgumentException("a " + value.getClass().getName() + " cannot be sent");
        }

        private Writer map(Map<?, ?> map) {
            put('{');
            String comma = "";
            for (Map.Entry<?, ?> entry : map.entrySet()) {
                ascii(comma).string(String.valueOf(entry.getKey())).put(':').value(entry.getValue());
                comma = ",";
            }
            return put('}');
        }

        private Writer string(String text) {
            put('"');
            for (int i = 0; i < text.length(); i++) {
                char c = text.charAt(i);
                if (c == '"' || c == '\\') {
                    put('\\').put(c);
                } else if (c >= 0x20 && c < 0x80) {
                    put(c);
                } else if (c < 0x20 || Character.isSurrogate(c) && !paired(text, i)) {
                    ascii(String.format("\\u%04x", (int) c));
                } else {
                    int point = text.codePointAt(i);
                    i += Character.charCount(point) - 1;
                    for (byte part : Character.toString(point).getBytes(StandardCharsets.UTF_8)) {
                        put(part);
                    }
                }
            }
            return put('"');
        }

        private static boolean paired(String text, int at) {
            return Character.isSupplementaryCodePoint(text.codePointAt(at));
        }

        @SuppressWarnings("deprecation") // the fastest way to get the bytes of ASCII
        private Writer ascii(String text) {
            int size = text.length();
            room(size);
            text.getBytes(0, size, bytes, length);
            length += size;
            return this;
        }

        private Writer put(int value) {
            room(1);
            bytes[length++] = (byte) value;
            return this;
        }

        private void room(int size) {
            if (length + size > bytes.length) {
                bytes = Arrays.copyOf(bytes, Math.max(2 * bytes.length, length + size));
            }
        }
    }

    private static final class Reader {
        private static final Map<String, Double> NOT_FINITE =
                Map.of("nan", Double.NaN, "inf", Double.POSITIVE_INFINITY, "-inf", Double.NEGATIVE_INFINITY);
        private final byte[] line;
        private final int end;
        private int at;
        private int depth;

        Reader(byte[] line, int begin, int end) {
            this.line = line;
            this.at = begin;
            this.end = end;
        }

        Map<?, ?> frame() {
            Object value;
            try {
                value = value();
            } catch (CharacterCodingException | NumberFormatException error) {
                throw wrong(error.toString());
            }
            if (blank() < end || !(value instanceof Map<?, ?> frame)) {
                throw wrong("one object was expected");
            }
            return frame;
        }

        private Object value() throws CharacterCodingException {
            return switch (next()) {
                case '{' -> object();
                case '[' -> array();
                case '"' -> string();
                case 't' -> word("true", Boolean.TRUE);
                case 'f' -> word("false", Boolean.FALSE);
                case 'n' -> word("null", null);
                default -> number();
            };
        }

        private Object object() throws CharacterCodingException {
            Map<String, Object> found = new LinkedHashMap<>();
            deeper();
            if (next() == '}') {
                at++;
            } else {
                do {
                    expect('"');
                    at--;
                    String key = string();
                    expect(':');
                    found.put(key, value());
                } while (more('}'));
            }
            depth--;
            Object named = found.size() == 1 && found.get("float") instanceof String name ? NOT_FINITE.get(name) : null;
            return named == null ? Collections.unmodifiableMap(found) : named;
        }

        private Object array() throws CharacterCodingException {
            List<Object> found = new ArrayList<>();
            deeper();
            if (next() == ']') {
                at++;
            } else {
                do {
                    found.add(value());
                } while (more(']'));
            }
            depth--;
            return Collections.unmodifiableList(found);
        }

        private boolean more(char closing) {
            int c = next();
            at++;
            if (c != ',' && c != closing) {
                throw wrong("a comma or " + closing + " was expected");
            }
            return c == ',';
        }

        private Object number() {
            int begin = at;
            boolean whole = true;
            while (at < end && "+-.0123456789eE".indexOf(line[at]) >= 0) {
                whole &= line[at] == '-' || line[at] >= '0' && line[at] <= '9';
                at++;
            }
            if (begin == at) {
                throw wrong("a value was expected");
            }
            String text = new String(line, begin, at - begin, StandardCharsets.ISO_8859_1);
            if (!whole) {
                return Double.valueOf(text);
            }
            if (text.length() < 19) {
                return Long.valueOf(text);
            }
            BigInteger value = new BigInteger(text);
            return value.bitLength() < 64 ? (Object) value.longValue() : value;
        }

        private String string() throws CharacterCodingException {
            int begin = ++at;
            StringBuilder text = null; // the text before the last escape
            boolean ascii = true;
            for (; at < end; at++) {
                if (line[at] == '"') {
                    String rest = decoded(begin, ascii);
                    at++;
                    return text == null ? rest : text.append(rest).toString();
                }
                if (line[at] == '\\') {
                    text = (text == null ? new StringBuilder() : text).append(decoded(begin, ascii)).append(escaped());
                    begin = at + 1;
                    ascii = true;
                } else {
                    ascii &= line[at] >= 0;
                }
            }
            throw wrong("a string does not end");
        }

        /** Decodes the current escape, and moves to its last byte. */
        private char escaped() {
            if (++at >= end) {
                throw wrong("a string does not end");
            }
            if (line[at] == 'u' && at + 4 < end) {
                String digits = new String(line, at + 1, 4, StandardCharsets.ISO_8859_1);
                at += 4;
                return (char) Integer.parseInt(digits, 16);
            }
            int which = "\"\\/bfnrt".indexOf(line[at]);
            if (which < 0) {
                throw wrong("there is no such escape");
            }
            return "\"\\/\b\f\n\r\t".charAt(which);
        }

        private String decoded(int begin, boolean ascii) throws CharacterCodingException {
            if (ascii) {
                return new String(line, begin, at - begin, StandardCharsets.ISO_8859_1);
            }
            return StandardCharsets.UTF_8.newDecoder().decode(ByteBuffer.wrap(line, begin, at - begin)).toString();
        }

        private Object word(String word, Object value) {
            for (int i = 0; i < word.length(); i++, at++) {
                if (at >= end || line[at] != word.charAt(i)) {
                    throw wrong(word + " was expected");
                }
            }
            return value;
        }

        private void expect(char wanted) {
            if (next() != wanted) {
                throw wrong(wanted + " was expected");
            }
            at++;
        }

        private void deeper() {
            at++;
            if (++depth > DEEPEST) {
                throw wrong("it is nested too deeply");
            }
        }

        /** The next byte that is not blank. */
        private int next() {
            if (blank() == end) {
                throw wrong("more was expected");
            }
            return line[at];
        }

        private int blank() {
            while (at < end && (line[at] == ' ' || line[at] == '\t' || line[at] == '\r')) {
                at++;
            }
            return at;
        }

        private WireError wrong(String what) {
            int first = Math.max(0, Math.min(at, end) - 80);
            String near = new String(line, first, Math.min(end - first, 160), StandardCharsets.ISO_8859_1);
            return new WireError("a line is not understood: " + what + ", near " + near);
        }
    }
}

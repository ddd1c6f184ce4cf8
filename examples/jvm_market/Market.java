package market;

import java.util.ArrayList;
import java.util.LinkedHashMap;
import java.util.List;
import java.util.Map;
import java.util.SplittableRandom;
import simenv.SimEnv;

/**
 * A market town, in weekly steps. Farms sow wheat and sell the harvest to a granary; shops bake bread from it and sell
 * the bread to households. Farms and shops that run out of money give up, and new ones enter while there are profits.
 *
 * <p>There are two kinds of decisions: how much a farm sows, some weeks before the price of the harvest is known, and
 * at what price a shop sells its bread.
 */
public final class Market {
    static final List<String> POINTS = List.of("farm.sow", "shop.price");
    static final int HOUSEHOLDS = 80;
    static final int GROWING = 4; // weeks
    static final int MOST = 20; // farms, shops, and plots of a farm
    static final double PLOT = 1.5; // the price of seed for a plot
    static final double UPKEEP = 4; // of a farm, per week
    static final double RENT = 8; // of a shop, per week

    private static Market running;

    private final List<Farm> farms = new ArrayList<>();
    private final List<Shop> shops = new ArrayList<>();
    private final List<double[]> trace = new ArrayList<>();
    private final int weeks;
    private SplittableRandom chance;
    private int week;
    private int founded;
    private int closed;
    private int fed;
    private double granary = 160;
    private double wheatPrice = 0.8;
    private double weather = 1;

    public static void main(String[] arguments) {
        if (!SimEnv.run(POINTS, Market::episode, seed -> running.chance = new SplittableRandom(seed))) {
            long seed = arguments.length > 0 ? Long.parseLong(arguments[0]) : 0;
            System.out.println(SimEnv.json(episode(seed, Map.of())));
        }
    }

    private static SimEnv.End episode(long seed, Map<String, Object> options) {
        running = new Market(seed, Long.getLong("market.weeks", 104));
        return running.live();
    }

    private Market(long seed, long weeks) {
        this.weeks = Math.toIntExact(weeks);
        chance = new SplittableRandom(seed);
        for (int i = 0; i < 8; i++) {
            farms.add(new Farm());
        }
        for (int i = 0; i < 6; i++) {
            shops.add(new Shop(2));
        }
    }

    private SimEnv.End live() {
        for (week = 0; week < weeks && !shops.isEmpty(); week++) {
            weather = 0.8 * weather + 0.2 * chance.nextDouble(0.4, 1.6);
            farms.forEach(Farm::work);
            granary *= 0.98;
            shuffle(shops);
            shops.forEach(Shop::open);
            sell();
            shops.forEach(Shop::shut);
            farms.removeIf(Farm::gaveUp);
            shops.removeIf(Shop::gaveUp);
            begin();
            trace.add(new double[] {farms.size(), shops.size(), wheatPrice, breadPrice()});
        }
        farms.forEach(farm -> SimEnv.update("farm.sow", farm.name, farm::look));
        shops.forEach(shop -> SimEnv.update("shop.price", shop.name, shop::look));
        Map<String, Object> result = new LinkedHashMap<>();
        result.put("weeks", week);
        result.put("founded", founded);
        result.put("closed", closed);
        result.put("fed", fed);
        result.put("granary", granary);
        result.put("trace", trace);
        return new SimEnv.End(result, !shops.isEmpty());
    }

    /** Each household visits two shops, and buys a loaf at the cheaper one, if it can. */
    private void sell() {
        for (int i = 0; i < HOUSEHOLDS; i++) {
            double budget = chance.nextDouble(1.2, 3.5);
            Shop one = shops.get(chance.nextInt(shops.size()));
            Shop other = shops.get(chance.nextInt(shops.size()));
            Shop first = one.price <= other.price ? one : other;
            Shop chosen = first.sold < first.baked ? first : first == one ? other : one;
            if (chosen.sold < chosen.baked && chosen.price <= budget) {
                chosen.sold++;
                fed++;
            }
        }
    }

    /** New farms and shops enter while there are profits. */
    private void begin() {
        if (farms.size() < MOST && wheatPrice > 0.9 && chance.nextDouble() < 0.2) {
            farms.add(new Farm());
        }
        double rich = 0;
        for (Shop shop : shops) {
            rich += shop.money / shops.size();
        }
        if (shops.size() < MOST && rich > 45 && chance.nextDouble() < 0.3) {
            shops.add(new Shop(breadPrice()));
        }
    }

    private double breadPrice() {
        double sum = 0;
        for (Shop shop : shops) {
            sum += shop.price;
        }
        return sum / Math.max(1, shops.size());
    }

    private <T> void shuffle(List<T> things) {
        for (int i = things.size() - 1; i > 0; i--) {
            int j = chance.nextInt(i + 1);
            things.set(i, things.set(j, things.get(i)));
        }
    }

    /** A farm, which sows, waits for the harvest, sells it, and sows again. */
    private final class Farm {
        final String name = "farm_" + ++founded;
        double money = 60;
        double earned;
        int plots = 10;
        int ripe = week + founded % GROWING; // not all in the same week

        void work() {
            earn(-UPKEEP);
            if (week < ripe) {
                return;
            }
            double harvest = plots * weather * chance.nextDouble(3, 5);
            granary += harvest;
            wheatPrice = 0.8 * Math.min(3, Math.max(0.25, 2.0 * HOUSEHOLDS / (granary + 1)));
            earn(harvest * wheatPrice);
            plots = sow();
            earn(-PLOT * plots);
            ripe = week + GROWING;
        }

        /** Chooses the number of plots to sow. */
        int sow() {
            return SimEnv.decideInt("farm.sow", name, this::look, this::sowByRule);
        }

        /** Expects today's price of wheat for the harvest. */
        int sowByRule() {
            return (int) Math.min(MOST, Math.max(0, 40 * (wheatPrice - PLOT / 4) - 6));
        }

        boolean gaveUp() {
            if (money < 0) {
                closed++;
                SimEnv.update("farm.sow", name, this::look);
                SimEnv.remove("farm.sow", name);
            }
            return money < 0;
        }

        void look(SimEnv.Arguments seen) {
            seen.time(week).put("money", money).put("earned", earned).put("plots", plots);
            seen.put("wheat_price", wheatPrice).put("granary", granary).put("farms", farms.size());
        }

        void earn(double amount) {
            money = Math.min(150, money + amount); // the family spends the surplus
            earned += amount;
        }
    }

    /** A shop, which bakes about as much as it sold last, and adapts its price. */
    private final class Shop {
        final String name = "shop_" + ++founded;
        double money = 40;
        double earned;
        double price;
        double cost = wheatPrice;
        int baked = 14;
        int sold = 14;

        Shop(double price) {
            this.price = price;
        }

        void open() {
            int wanted = (int) Math.min(1.2 * sold + 2, granary);
            price = choosePrice();
            baked = wanted;
            sold = 0;
            cost = wheatPrice;
            granary -= baked;
            earn(-baked * cost);
        }

        /** Chooses the price of a loaf. */
        double choosePrice() {
            return SimEnv.decideDouble("shop.price", name, this::look, this::priceByRule);
        }

        /** Raises the price if all loaves were sold, lowers it if many were not. */
        double priceByRule() {
            double change = sold == baked ? 1.04 : sold < 0.8 * baked ? 0.96 : 1;
            return Math.max(1.1 * wheatPrice, change * price);
        }

        boolean gaveUp() {
            if (money < 0) {
                closed++;
                SimEnv.update("shop.price", name, this::look);
                SimEnv.remove("shop.price", name);
            }
            return money < 0;
        }

        void look(SimEnv.Arguments seen) {
            seen.time(week).put("money", money).put("earned", earned).put("price", price);
            seen.put("baked", baked).put("sold", sold).put("wheat_price", wheatPrice).put("shops", shops.size());
        }

        void shut() {
            earn(sold * price - RENT);
        }

        void earn(double amount) {
            money = Math.min(100, money + amount); // the owner spends the surplus
            earned += amount;
        }
    }
}

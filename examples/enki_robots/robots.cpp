// E-pucks that sweep an arena, simulated with Enki. Robots come in pairs and leave when their batteries are empty; each
// chooses its direction twice a second.
//
//     robots [SEED [OPTIONS]]      prints the result, e.g. robots 7 '{"seconds": 60}'
//
// The arena consists of square cells, which get dirty at random. A cell is clean once a robot has been on it.

#include <enki/PhysicalEngine.h>
#include <enki/robots/e-puck/EPuck.h>

#include <simenv.hpp>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <iostream>
#include <memory>
#include <random>
#include <string>
#include <vector>

namespace {

constexpr const char* POINT = "robot.turn";
constexpr int COLUMNS = 12, ROWS = 8;
constexpr double CELL = 10, STEP = 0.1, SPEED = 8;  // cm, s, cm/s
constexpr int STEPS_PER_DECISION = 5, STEPS_PER_PAIR = 200;

/// A robot: an e-puck with a battery.
struct Robot : Enki::EPuck {
    std::string name;
    int charge = 0;  ///< The decisions that its battery lasts for.
    double turn = 0;
};

/// An arena, and the robots that come and leave.
class Arena {
  public:
    Arena(simenv::Client& client, const simenv::Episode& episode)
        : m_client(client), m_steps(static_cast<int>(episode.option("seconds", 120.0) / STEP)),
          m_world(COLUMNS * CELL, ROWS * CELL), m_robots(new Robot[2 * Pairs()]) {
        m_world.takeObjectOwnership = false;
        Seed(episode.seed);
    }
    ~Arena() { m_world.objects.clear(); }
    Arena(const Arena&) = delete;

    void Run() {
        for (m_step = 0; m_step < m_steps; ++m_step) {
            m_dirty[m_chance() % m_dirty.size()] = true;
            if (m_step % STEPS_PER_PAIR == 0) Join();
            if (m_step % STEPS_PER_DECISION == 0) Decide();
            m_world.step(STEP, 3);
            for (const Robot* robot : m_active) Sweep(*robot);
        }
        for (const Robot* robot : m_active) Tell(*robot);
    }

    /// Seeds all future random draws: those of the arena, and those of Enki's motors and sensors.
    void Seed(std::uint64_t seed) {
        m_chance.seed(static_cast<std::uint32_t>(seed));
        m_world.setRandomSeed(static_cast<unsigned long>(m_chance()));
        std::srand(static_cast<unsigned>(m_chance()));
    }

    simenv::Json Result() const {
        return simenv::Json::Object{{"checksum", std::to_string(m_sum)}, {"robots", m_joined}, {"swept", m_swept}};
    }

  private:
    int Pairs() const { return (m_steps + STEPS_PER_PAIR - 1) / STEPS_PER_PAIR; }

    /// Lets two robots in, at opposite sides.
    void Join() {
        for (const int side : {0, 1}) {
            Robot& robot = m_robots[m_joined];
            robot.name = "robot_" + std::to_string(m_joined++);
            robot.charge = 60 + static_cast<int>(m_chance() % 60);
            robot.pos = Enki::Point(side ? m_world.w - CELL : CELL, m_world.h * static_cast<double>(m_chance() % 6 + 1) / 7);
            robot.angle = side ? M_PI : 0;
            m_world.addObject(&robot);
            m_active.push_back(&robot);
        }
    }

    /// Lets each robot choose its direction, after those without charge have left. All robots of a round are known, with
    /// what they see now, before one of them decides.
    void Decide() {
        for (Robot* robot : std::vector<Robot*>(m_active))
            if (robot->charge-- == 0) Leave(robot);
        for (const Robot* robot : m_active)
            m_client.expect(POINT, robot->name, [&] { return State(*robot); }, Now());
        for (Robot* robot : m_active) {
            const double turn = m_client.decide(
                POINT, robot->name, [&] { return State(*robot); }, [&] { return Rule(*robot); }, Now());
            robot->turn = std::min(std::max(turn, -1.0), 1.0);
            robot->leftSpeed = SPEED * std::min(1.0, 1 - 2 * robot->turn);
            robot->rightSpeed = SPEED * std::min(1.0, 1 + 2 * robot->turn);
            Add(robot->pos.x), Add(robot->pos.y), Add(robot->turn);
        }
    }

    void Leave(Robot* robot) {
        Tell(*robot);
        m_client.remove(POINT, robot->name);
        m_world.objects.erase(robot);
        m_active.erase(std::find(m_active.begin(), m_active.end(), robot));
    }

    void Tell(const Robot& robot) const { m_client.update(POINT, robot.name, [&] { return State(robot); }, Now()); }

    /// Cleans the cell of a robot.
    void Sweep(const Robot& robot) {
        const int column = static_cast<int>(robot.pos.x / CELL), row = static_cast<int>(robot.pos.y / CELL);
        if (column < 0 || column >= COLUMNS || row < 0 || row >= ROWS) return;
        const auto cell = static_cast<std::size_t>(row * COLUMNS + column);
        m_swept += m_dirty[cell];
        m_dirty[cell] = false;
    }

    /// The angle to a point as seen from a robot; positive is left.
    static double Bearing(const Robot& robot, const Enki::Point& point) {
        return Enki::normalizeAngle((point - robot.pos).angle() - robot.angle);
    }

    /// The dirty cell that is nearest to a robot and not nearer to another one; its own place if there is none.
    Enki::Point Target(const Robot& robot) const {
        Enki::Point nearest = robot.pos;
        double least = INFINITY;
        for (std::size_t i = 0; i < m_dirty.size(); ++i) {
            const Enki::Point cell((static_cast<double>(i % COLUMNS) + 0.5) * CELL,
                                   (static_cast<double>(i / COLUMNS) + 0.5) * CELL);
            const double distance = (cell - robot.pos).norm();
            bool mine = m_dirty[i] && distance < least;
            for (const Robot* other : m_active)
                mine = mine && (other == &robot || (cell - other->pos).norm() > distance);
            if (mine) nearest = cell, least = distance;
        }
        return nearest;
    }

    /// Turns away from what is near in front, otherwise towards the robot's own dirty cell.
    double Rule(const Robot& robot) const {
        const double right = robot.infraredSensor0.getValue() + robot.infraredSensor1.getValue();
        const double left = robot.infraredSensor6.getValue() + robot.infraredSensor7.getValue();
        if (right + left > 300) return right > left ? 1 : -1;
        return std::min(std::max(Bearing(robot, Target(robot)), -1.0), 1.0);
    }

    simenv::Json State(const Robot& robot) const {
        double least = m_world.w, bearing = 0;
        for (const Robot* other : m_active)
            if (const double distance = (other->pos - robot.pos).norm(); other != &robot && distance < least)
                least = distance, bearing = Bearing(robot, other->pos);
        const Enki::Point target = Target(robot);
        const std::vector<double> sensors{robot.infraredSensor0.getValue(), robot.infraredSensor1.getValue(),
                                          robot.infraredSensor6.getValue(), robot.infraredSensor7.getValue()};
        return simenv::Json::Object{{"sensors", sensors},
                                    {"other", std::vector<double>{least, bearing}},
                                    {"dirt", std::vector<double>{(target - robot.pos).norm(), Bearing(robot, target)}},
                                    {"charge", robot.charge},
                                    {"swept", m_swept}};
    }

    double Now() const { return m_step * STEP; }

    /// Adds a number to the checksum, which reveals any difference between two runs.
    void Add(double value) {
        unsigned char bytes[sizeof value];
        std::memcpy(bytes, &value, sizeof value);
        for (const unsigned char byte : bytes) m_sum = (m_sum ^ byte) * 1099511628211u;
    }

    simenv::Client& m_client;
    const int m_steps;
    Enki::World m_world;
    // All robots of the episode in one array: Enki steps objects in the order of their addresses, and draws noise then.
    const std::unique_ptr<Robot[]> m_robots;
    std::vector<Robot*> m_active;
    std::vector<bool> m_dirty = std::vector<bool>(COLUMNS * ROWS, true);
    std::mt19937 m_chance;
    int m_step = 0, m_joined = 0, m_swept = 0;
    std::uint64_t m_sum = 14695981039346656037u;
};

}  // namespace

int main(int argc, char** argv) {
    simenv::Client client({POINT});
    Arena* running = nullptr;
    client.on_reseed([&](std::uint64_t seed) { running->Seed(seed); });
    const auto model = [&](const simenv::Episode& episode) {
        Arena arena(client, episode);
        running = &arena;
        arena.Run();
        client.end(arena.Result(), true);
        if (!client.connected()) std::cout << arena.Result().text() << std::endl;
    };
    return client.run(model, argc > 1 ? std::stoull(argv[1]) : 0,
                      argc > 2 ? simenv::Json::parse(argv[2]) : simenv::Json::Object());
}

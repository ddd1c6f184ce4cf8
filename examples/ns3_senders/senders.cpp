// Senders that share a bottleneck, simulated with ns-3. Senders join and leave; each chooses its rate at
// acknowledgements and timeouts.
//
//     senders [SEED [OPTIONS]]      prints the result, e.g. senders 7 '{"seconds": 20}'
//
// Each sender has its own host, with a link to a router; each of these links has another delay. The bottleneck is the
// link from the router to the receiver, which acknowledges each packet. The bottleneck's rate changes every few
// seconds, and its queue drops packets when it is full.

#include <ns3/core-module.h>
#include <ns3/internet-module.h>
#include <ns3/network-module.h>
#include <ns3/point-to-point-module.h>
#include <ns3/traffic-control-module.h>

#include <simenv.hpp>

#include <algorithm>
#include <cstring>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

using namespace ns3;

namespace {

constexpr const char* POINT = "sender.rate";
constexpr uint32_t PACKET = 1000;                                          // bytes
constexpr double FIRST_RATE = 2e5, LOWEST_RATE = 2e4, HIGHEST_RATE = 1e7;  // bit/s
constexpr double PATIENCE = 0.3;  // the timeout: seconds without an acknowledgement

/// The record of an episode: a checksum over all events, which reveals any difference, and queueing delays.
class Record {
  public:
    template <class T> void Add(const T& value) {
        unsigned char bytes[sizeof value];
        std::memcpy(bytes, &value, sizeof value);
        for (const unsigned char byte : bytes) m_sum = (m_sum ^ byte) * 1099511628211u;
    }
    void Acknowledged(double sent, double rtt, double least) {
        Add(sent);
        Add(rtt);
        m_queueing += rtt - least;
        ++m_acknowledged;
    }
    std::string Sum() const { return std::to_string(m_sum); }
    double Queueing() const { return m_acknowledged ? m_queueing / m_acknowledged : 0; }

  private:
    uint64_t m_sum = 14695981039346656037u;
    double m_queueing = 0;
    int m_acknowledged = 0;
};

/// The header of each packet, which its acknowledgement returns.
struct Stamp {
    uint32_t number;
    double sent;
};

/// A sender, which adapts its rate.
class Sender {
  public:
    Sender(simenv::Client& client, Record& record, std::string name, Ptr<Node> host, const Address& receiver)
        : m_client(client), m_record(record), m_name(std::move(name)), m_decided(Simulator::Now().GetSeconds()) {
        m_socket = Socket::CreateSocket(host, UdpSocketFactory::GetTypeId());
        m_socket->Bind();
        m_socket->Connect(receiver);
        m_socket->SetRecvCallback(MakeCallback(&Sender::Acknowledged, this));
        m_timer = Simulator::Schedule(Seconds(PATIENCE), &Sender::TimedOut, this);
        Send();
    }
    ~Sender() {
        m_client.remove(POINT, m_name);
        m_next.Cancel();
        m_timer.Cancel();
        m_socket->SetRecvCallback(MakeNullCallback<void, Ptr<Socket>>());
        m_socket->Close();
    }
    Sender(const Sender&) = delete;

    /// Reports the final state, after the last decision.
    void Tell() const { m_client.update(POINT, m_name, [&] { return State(false); }, Simulator::Now().GetSeconds()); }

  private:
    void Send() {
        const Stamp stamp{m_sent++, Simulator::Now().GetSeconds()};
        uint8_t bytes[PACKET] = {};
        std::memcpy(bytes, &stamp, sizeof stamp);
        m_socket->Send(Create<Packet>(bytes, PACKET));
        m_next = Simulator::Schedule(Seconds(8 * PACKET / m_rate), &Sender::Send, this);
    }

    void Acknowledged(Ptr<Socket> socket) {
        while (Ptr<Packet> packet = socket->Recv()) {
            Stamp stamp;
            packet->CopyData(reinterpret_cast<uint8_t*>(&stamp), sizeof stamp);
            m_rtt = Simulator::Now().GetSeconds() - stamp.sent;
            m_least = std::min(m_least, m_rtt);
            m_record.Acknowledged(stamp.sent, m_rtt, m_least);
            if (stamp.number < m_mark) continue;
            m_lost += stamp.number - std::max(m_expected, m_mark);  // packets stay in order on this path
            m_expected = stamp.number + 1;
            ++m_arrived;
            if (stamp.sent >= m_decided + m_rtt) Decide(false);
        }
    }

    void TimedOut() { Decide(true); }

    /// Evaluates the present rate by the packets that were sent at it, and changes it.
    void Decide(bool timer) {
        const double now = Simulator::Now().GetSeconds();
        try {
            const double factor = m_client.decide(
                POINT, m_name, [&] { return State(timer); }, [&] { return Rule(timer); }, now);
            m_rate = std::min(std::max(m_rate * factor, LOWEST_RATE), HIGHEST_RATE);
        } catch (const simenv::Stop&) {
            return Simulator::Stop();  // not through ns-3, which frees an event only after it returns
        }
        m_record.Add(m_rate);
        m_decided = now;
        m_mark = m_sent;
        m_lost = m_arrived = 0;
        m_timer.Cancel();
        m_timer = Simulator::Schedule(Seconds(PATIENCE + 3 * m_rtt), &Sender::TimedOut, this);
    }

    /// The factor of TCP's rule: half the rate after a loss, otherwise one more packet for each round trip.
    double Rule(bool timer) const { return Loss(timer) > 0 ? 0.5 : 1 + 8 * PACKET / m_rtt / m_rate; }

    /// The share of lost packets among those sent at the present rate.
    double Loss(bool timer) const { return timer ? 1.0 : m_lost ? double(m_lost) / (m_lost + m_arrived) : 0.0; }

    simenv::Json State(bool timer) const {
        return simenv::Json::Object{
            {"rate", m_rate}, {"loss", Loss(timer)}, {"rtt", m_rtt}, {"least_rtt", m_least}, {"timer", timer}};
    }

    simenv::Client& m_client;
    Record& m_record;
    std::string m_name;
    Ptr<Socket> m_socket;
    EventId m_next, m_timer;
    double m_decided;
    double m_rate = FIRST_RATE, m_rtt = PATIENCE, m_least = PATIENCE;
    uint32_t m_sent = 0, m_expected = 0, m_mark = 0, m_lost = 0, m_arrived = 0;
};

/// The network, and the senders that join and leave it.
class Network {
  public:
    Network(simenv::Client& client, const simenv::Episode& episode)
        : m_client(client), m_seconds(episode.option("seconds", 30.0)), m_senders(episode.option("hosts", 6)) {
        Seed(episode.seed);
        NodeContainer hosts(m_senders.size()), middle(2);
        InternetStackHelper().Install(NodeContainer(hosts, middle));
        PointToPointHelper link;
        Ipv4AddressHelper addresses("10.1.1.0", "255.255.255.0");
        link.SetQueue("ns3::DropTailQueue", "MaxSize", StringValue("40p"));
        link.SetDeviceAttribute("DataRate", StringValue("100Mbps"));
        m_bottleneck = link.Install(middle);
        const Ipv4Address receiver = Addresses(addresses, m_bottleneck).GetAddress(1);
        for (uint32_t i = 0; i < hosts.GetN(); ++i) {
            link.SetChannelAttribute("Delay", TimeValue(Seconds(m_delay->GetValue(0.005, 0.03))));
            Addresses(addresses, link.Install(hosts.Get(i), middle.Get(0)));
        }
        Ipv4GlobalRoutingHelper::PopulateRoutingTables();
        m_hosts = hosts;
        m_receiver = InetSocketAddress(receiver, 9);
        m_sink = Socket::CreateSocket(middle.Get(1), UdpSocketFactory::GetTypeId());
        m_sink->Bind(InetSocketAddress(Ipv4Address::GetAny(), 9));
        m_sink->SetRecvCallback(MakeCallback(&Network::Received, this));
    }
    ~Network() {
        m_senders.clear();
        Simulator::Destroy();
    }
    Network(const Network&) = delete;

    void Run() {
        Simulator::Stop(Seconds(m_seconds));
        ChangeRate();
        Join();
        Simulator::Run();
        for (const auto& sender : m_senders)
            if (sender) sender->Tell();
    }

    /// Seeds all future random draws.
    void Seed(uint64_t seed) {
        RngSeedManager::SetRun(seed);
        int64_t stream = 0;
        for (RandomVariableStream* variable : std::initializer_list<RandomVariableStream*>{
                 PeekPointer(m_capacity), PeekPointer(m_delay), PeekPointer(m_pause), PeekPointer(m_stay)})
            variable->SetStream(stream++);
    }

    simenv::Json Result() const {
        return simenv::Json::Object{{"checksum", m_record.Sum()},
                                    {"senders", m_joined},
                                    {"megabits", 8e-6 * PACKET * m_received},
                                    {"queueing", m_record.Queueing()}};
    }

  private:
    Ipv4InterfaceContainer Addresses(Ipv4AddressHelper& addresses, const NetDeviceContainer& devices) {
        const Ipv4InterfaceContainer interfaces = addresses.Assign(devices);
        addresses.NewNetwork();
        TrafficControlHelper().Uninstall(devices);  // only the devices' own queues remain
        return interfaces;
    }

    void ChangeRate() {
        const DataRate rate(uint64_t(m_capacity->GetValue(1e6, 4e6)));
        m_bottleneck.Get(0)->SetAttribute("DataRate", DataRateValue(rate));
        Simulator::Schedule(Seconds(3), &Network::ChangeRate, this);
    }

    void Join() {
        for (uint32_t i = 0; i < m_senders.size(); ++i) {
            if (m_senders[i]) continue;
            const std::string name = "sender_" + std::to_string(m_joined++);
            m_senders[i] = std::make_unique<Sender>(m_client, m_record, name, m_hosts.Get(i), m_receiver);
            Simulator::Schedule(Seconds(m_stay->GetValue(8, 0)), &Network::Leave, this, i);
            break;
        }
        Simulator::Schedule(Seconds(m_pause->GetValue(2, 0)), &Network::Join, this);
    }

    void Leave(uint32_t i) {
        m_senders[i]->Tell();
        m_senders[i].reset();
    }

    void Received(Ptr<Socket> socket) {
        Address from;
        while (Ptr<Packet> packet = socket->RecvFrom(from)) {
            ++m_received;
            socket->SendTo(packet->CreateFragment(0, sizeof(Stamp)), 0, from);
        }
    }

    simenv::Client& m_client;
    double m_seconds;
    Record m_record;
    int m_received = 0;
    int m_joined = 0;
    std::vector<std::unique_ptr<Sender>> m_senders;  // by host
    NodeContainer m_hosts;
    NetDeviceContainer m_bottleneck;
    Address m_receiver;
    Ptr<Socket> m_sink;
    Ptr<UniformRandomVariable> m_capacity = CreateObject<UniformRandomVariable>();
    Ptr<UniformRandomVariable> m_delay = CreateObject<UniformRandomVariable>();
    Ptr<ExponentialRandomVariable> m_pause = CreateObject<ExponentialRandomVariable>();
    Ptr<ExponentialRandomVariable> m_stay = CreateObject<ExponentialRandomVariable>();
};

}  // namespace

int main(int argc, char** argv) {
    simenv::Client client({POINT});
    Network* running = nullptr;
    client.on_reseed([&](uint64_t seed) { running->Seed(seed); });
    const auto model = [&](const simenv::Episode& episode) {
        Network network(client, episode);
        running = &network;
        network.Run();
        client.end(network.Result(), true);
        if (!client.connected()) std::cout << network.Result().text() << std::endl;
    };
    return client.run(model, argc > 1 ? std::stoull(argv[1]) : 0,
                      argc > 2 ? simenv::Json::parse(argv[2]) : simenv::Json::Object());
}

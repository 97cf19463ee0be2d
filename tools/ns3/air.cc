// Radios of IEEE 802.11 in ad-hoc mode at fixed places, in ns-3 3.37: which frames they receive, and when.
//
// Standard input: the number of radios; their places (x and y, metres); then, until the end, one line a frame: when it
// is handed to the radio (seconds), its sender, its target (-1: all) and its bytes; IP and UDP headers are added here.
// Standard output: one line a reception: the frame's number, the hearer, and the time (seconds). Overheard frames are
// not printed.

#include "ns3/core-module.h"
#include "ns3/mobility-module.h"
#include "ns3/network-module.h"
#include "ns3/propagation-module.h"
#include "ns3/wifi-module.h"

#include <cstdio>
#include <deque>
#include <iostream>
#include <vector>

using namespace ns3;

namespace {

// IPv4 20, UDP 8. The device adds LLC, SNAP, the MAC's header and the check sequence.
constexpr uint32_t kHeaders = 28;

// What is or was on the air.
struct Transmission {
  Time begin, end;
  uint32_t sender;
};
std::deque<Transmission> g_air;

// Any overlap destroys: a frame is corrupt if another was on the air at the radio while it was received.
class Fragile : public ErrorModel {
 public:
  Fragile(Ptr<Node> node, double range) : node_(node), range_(range) {}

 private:
  bool DoCorrupt(Ptr<Packet>) override {
    // The slack is more than the time that signals take over the range.
    const auto now = Simulator::Now(), slack = NanoSeconds(200);
    std::vector<Transmission> here;
    for (const auto& one : g_air) {
      if (one.sender != node_->GetId() && Near(one.sender)) here.push_back(one);
    }
    for (const auto& received : here) {
      if (Abs(received.end - now) > slack) continue;
      for (const auto& other : here) {
        const auto overlaps = other.begin < now - slack && other.end > received.begin + slack;
        if (other.sender != received.sender && overlaps) return true;
      }
    }
    return false;
  }
  void DoReset() override {}
  bool Near(uint32_t other) const {
    auto place = node_->GetObject<MobilityModel>();
    return place->GetDistanceFrom(NodeList::GetNode(other)->GetObject<MobilityModel>()) <= range_;
  }

  Ptr<Node> node_;
  double range_;
};

void Began(Ptr<WifiPhy> phy, WifiConstPsduMap psdus, WifiTxVector vector, double) {
  const auto now = Simulator::Now();
  // The longest frame takes less than 20 ms.
  while (!g_air.empty() && g_air.front().begin < now - MilliSeconds(50)) g_air.pop_front();
  const auto takes = WifiPhy::CalculateTxDuration(psdus, vector, phy->GetPhyBand());
  g_air.push_back({now, now + takes, phy->GetDevice()->GetNode()->GetId()});
}

class Number : public Tag {
 public:
  explicit Number(uint32_t value = 0) : value(value) {}
  static TypeId GetTypeId() {
    static TypeId id = TypeId("Number").SetParent<Tag>().AddConstructor<Number>();
    return id;
  }
  TypeId GetInstanceTypeId() const override { return GetTypeId(); }
  uint32_t GetSerializedSize() const override { return 4; }
  void Serialize(TagBuffer buffer) const override { buffer.WriteU32(value); }
  void Deserialize(TagBuffer buffer) override { value = buffer.ReadU32(); }
  void Print(std::ostream& out) const override { out << value; }

  uint32_t value;
};

bool Received(Ptr<NetDevice> device, Ptr<const Packet> packet, uint16_t, const Address&) {
  Number number;
  packet->PeekPacketTag(number);
  std::printf("%u %u %.9f\n", number.value, device->GetNode()->GetId(), Simulator::Now().GetSeconds());
  return true;
}

void Send(Ptr<NetDevice> device, Address to, uint32_t number, uint32_t bytes) {
  auto packet = Create<Packet>(kHeaders + bytes);
  packet->AddPacketTag(Number(number));
  device->Send(packet, to, 0x0800);
}

}  // namespace

int main(int argc, char* argv[]) {
  std::string phy = "1m", overlap = "physics";
  double range = 10.0;
  uint32_t tries = 8, queue = 65536, run = 1;
  CommandLine command(__FILE__);
  command.AddValue("phy", "1m (802.11b) or 6m (802.11a)", phy);
  command.AddValue("overlap", "physics: as ns-3 has it; fragile: any overlap destroys", overlap);
  command.AddValue("range", "radios at most so far away hear and notice each other, metres", range);
  command.AddValue("tries", "how often a frame is sent that nobody acknowledges", tries);
  command.AddValue("queue", "frames that wait in a radio", queue);
  command.AddValue("run", "number of the random run", run);
  command.Parse(argc, argv);
  RngSeedManager::SetRun(run);

  uint32_t count = 0;
  std::cin >> count;
  auto places = CreateObject<ListPositionAllocator>();
  for (uint32_t i = 0; i < count; ++i) {
    double x = 0.0, y = 0.0;
    std::cin >> x >> y;
    places->Add(Vector(x, y, 0.0));
  }
  NodeContainer nodes(count);
  MobilityHelper mobility;
  mobility.SetPositionAllocator(places);
  mobility.SetMobilityModel("ns3::ConstantPositionMobilityModel");
  mobility.Install(nodes);

  YansWifiChannelHelper channel;
  channel.SetPropagationDelay("ns3::ConstantSpeedPropagationDelayModel");
  channel.AddPropagationLoss("ns3::RangePropagationLossModel", "MaxRange", DoubleValue(range));
  YansWifiPhyHelper radio;
  radio.SetChannel(channel.Create());
  WifiHelper wifi;
  const auto slow = phy == "1m";
  wifi.SetStandard(slow ? WIFI_STANDARD_80211b : WIFI_STANDARD_80211a);
  const StringValue mode(slow ? "DsssRate1Mbps" : "OfdmRate6Mbps");
  wifi.SetRemoteStationManager("ns3::ConstantRateWifiManager", "DataMode", mode, "ControlMode", mode,
                               "NonUnicastMode", mode, "MaxSsrc", UintegerValue(tries), "MaxSlrc",
                               UintegerValue(tries));
  Config::SetDefault("ns3::WifiMacQueue::MaxSize", QueueSizeValue(QueueSize(QueueSizeUnit::PACKETS, queue)));
  Config::SetDefault("ns3::WifiMacQueue::MaxDelay", TimeValue(Seconds(1e6)));
  WifiMacHelper mac;
  mac.SetType("ns3::AdhocWifiMac", "QosSupported", BooleanValue(false));
  auto devices = wifi.Install(radio, mac, nodes);
  for (uint32_t i = 0; i < count; ++i) {
    devices.Get(i)->SetReceiveCallback(MakeCallback(&Received));
    auto phy = DynamicCast<WifiNetDevice>(devices.Get(i))->GetPhy();
    if (overlap == "fragile") {
      phy->TraceConnectWithoutContext("PhyTxPsduBegin", MakeBoundCallback(&Began, phy));
      phy->SetPostReceptionErrorModel(CreateObject<Fragile>(nodes.Get(i), range));
    }
  }

  double at = 0.0, last = 0.0;
  int64_t sender = 0, target = 0;
  uint32_t bytes = 0, number = 0;
  while (std::cin >> at >> sender >> target >> bytes) {
    auto device = devices.Get(sender);
    auto to = target < 0 ? device->GetBroadcast() : devices.Get(target)->GetAddress();
    Simulator::Schedule(Seconds(at), &Send, device, to, number++, bytes);
    last = std::max(last, at);
  }
  // What waits is sent, too.
  Simulator::Stop(Seconds(last + 600.0));
  Simulator::Run();
  Simulator::Destroy();
  return 0;
}

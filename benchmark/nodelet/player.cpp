// Plays the row of nodelets in one manager; the commands are those of benchmark/player.py.
#include <atomic>
#include <iostream>
#include <map>
#include <sstream>
#include <thread>
#include <unistd.h>

#include <boost/make_shared.hpp>
#include <geometry_msgs/Twist.h>
#include <nodelet/loader.h>
#include <nodelet/nodelet.h>
#include <ros/ros.h>
#include <sensor_msgs/Image.h>

namespace {

constexpr std::size_t STAMPS = 1 << 21, SAMPLES = 4000;    // messages of a slice, latencies that are answered at most

double seconds_of(clockid_t which) {
  timespec now;
  return clock_gettime(which, &now), now.tv_sec + now.tv_nsec * 1e-9;
}
double now() { return seconds_of(CLOCK_MONOTONIC); }
double cpu() { return seconds_of(CLOCK_PROCESS_CPUTIME_ID); }
void pause(double seconds) { std::this_thread::sleep_for(std::chrono::duration<double>(seconds)); }

std::vector<double> sent(STAMPS);

// Each receiver notes into a vector of its own.
struct Notes {
  std::vector<float> took = std::vector<float>(STAMPS);
  std::atomic<std::size_t> count{0};
  void note(std::size_t index) {
    if (count < STAMPS) took[count] = now() - sent[index], ++count;
  }
};

std::size_t index_of(const geometry_msgs::Twist& message) { return message.linear.x; }
std::size_t index_of(const sensor_msgs::Image& message) { return message.step; }

struct Setting { std::string kind, topic; unsigned receivers, queue_size; };

// What is open: subscribers, and how to publish the message of an index.
struct Way {
  std::vector<std::unique_ptr<Notes>> notes;
  std::vector<ros::Subscriber> subscribers;
  ros::Publisher publisher;
  std::vector<boost::shared_ptr<sensor_msgs::Image>> images;    // more than queues hold: none changes in use
  boost::shared_ptr<geometry_msgs::Twist> twist;

  void prepare(std::size_t index) {    // before the stamp, as Python's message is filled there, too
    if (images.empty()) twist = boost::make_shared<geometry_msgs::Twist>(), twist->linear.x = index;
    else images[index % images.size()]->step = index;
  }
  void publish(std::size_t index) {
    if (images.empty()) publisher.publish(boost::shared_ptr<const geometry_msgs::Twist>(twist));
    else publisher.publish(boost::shared_ptr<const sensor_msgs::Image>(images[index % images.size()]));
  }
};

Way* opening;
Setting setting;

struct Receiver : nodelet::Nodelet {
  template <class M> void open() {
    opening->notes.push_back(std::make_unique<Notes>());
    auto note = [mine = opening->notes.back().get()](const boost::shared_ptr<const M>& m) { mine->note(index_of(*m)); };
    boost::function<void(const boost::shared_ptr<const M>&)> callback(note);
    opening->subscribers.push_back(getNodeHandle().subscribe<M>(setting.topic, setting.queue_size, callback));
  }
  void onInit() override {
    setting.kind == "twist" ? open<geometry_msgs::Twist>() : open<sensor_msgs::Image>();
  }
};

struct Sender : nodelet::Nodelet {
  template <class M> void open() { opening->publisher = getNodeHandle().advertise<M>(setting.topic, setting.queue_size); }
  void onInit() override {
    setting.kind == "twist" ? open<geometry_msgs::Twist>() : open<sensor_msgs::Image>();
  }
};

boost::shared_ptr<nodelet::Nodelet> create(const std::string& type) {
  return type == "receiver" ? boost::shared_ptr<nodelet::Nodelet>(new Receiver) : boost::make_shared<Sender>();
}

class Player {
 public:
  explicit Player(const std::string& name)
      : name_(name), loader_(boost::function<boost::shared_ptr<nodelet::Nodelet>(const std::string&)>(create)) {}

  void run(std::istream& commands, FILE* answers) {
    for (std::string line; std::getline(commands, line);) {
      std::istringstream words(line);
      std::string command;
      words >> command;
      std::ostringstream answer;
      answer.precision(12);
      if (command == "open") open(words);
      if (command == "begin") begin(words);
      if (command == "send") send(words, answer);
      if (command == "result") result(words, answer);
      fprintf(answers, "{%s}\n", answer.str().c_str());
      fflush(answers);
    }
  }

 private:
  void read(std::istream& words) {
    words >> setting.kind >> setting.receivers >> setting.queue_size;
    std::ostringstream topic;
    topic << "/" << name_ << "/" << setting.kind << "/" << setting.receivers << "/" << setting.queue_size;
    setting.topic = topic.str();
  }

  void open(std::istream& words) {
    read(words);
    opening = &ways_[setting.topic];
    const std::string prefix = setting.topic + "/nodelet";
    for (unsigned i = 0; i < setting.receivers; ++i) loader_.load(prefix + std::to_string(i), "receiver", {}, {});
    loader_.load(prefix, "sender", {}, {});
    while (opening->publisher.getNumSubscribers() < 1) pause(0.01);
    for (unsigned i = 0; setting.kind != "twist" && i < setting.queue_size + 6; ++i) {
      opening->images.push_back(boost::make_shared<sensor_msgs::Image>());
      opening->images.back()->data.resize(3 * 1920 * 1080);
    }
  }

  void begin(std::istream& words) {
    read(words);
    way_ = &ways_.at(setting.topic);
    for (auto& notes : way_->notes) notes->count = 0;
    cpu_ = cpu();
  }

  void send(std::istream& words, std::ostream& answer) {
    double rate, seconds;
    int busy;
    words >> rate >> seconds >> busy;
    const double begun = now();
    double due = begun;
    std::size_t index = 0;
    while (index < STAMPS && (rate == 0 || index < static_cast<std::size_t>(rate * seconds))) {
      way_->prepare(index);
      const double stamp = sent[index] = now();
      way_->publish(index++);
      if (rate == 0 && stamp > begun + seconds) break;
      due += rate == 0 ? 0 : 1 / rate;
      while (busy && now() < due) {}
      if (rate != 0) pause(std::max(0.0, due - now()));
    }
    answer << "\"sent\": " << index << ", \"begun\": " << begun << ", \"took\": " << now() - begun;
  }

  void result(std::istream& words, std::ostream& answer) {
    std::size_t expected, arrived = 0;
    double silence, last = now(), used = cpu();    // silence: seconds after which the rest is lost
    words >> expected >> silence;
    for (bool first = true; arrived < expected && now() - last < silence; first = false) {
      std::size_t sum = 0;
      for (auto& notes : way_->notes) sum += notes->count;
      if (first || sum > arrived) arrived = sum, last = now(), used = cpu();
      pause(0.002);
    }
    answer << "\"received\": " << arrived << ", \"last\": " << last << ", \"cpu\": " << used - cpu_ << ", \"took\": [";
    const std::size_t stride = arrived / SAMPLES + 1;
    const char* separator = "";
    for (auto& notes : way_->notes)
      for (std::size_t i = 0; i < notes->count; i += stride, separator = ", ") answer << separator << notes->took[i];
    answer << "]";
  }

  std::string name_;
  nodelet::Loader loader_;
  std::map<std::string, Way> ways_;
  Way* way_ = nullptr;
  double cpu_ = 0;
};

}  // namespace

int main(int argc, char** argv) {
  FILE* answers = fdopen(dup(1), "w");
  dup2(2, 1);    // an answer is not mixed with what ROS prints
  ros::init(argc, argv, std::string(argv[2]) + "_player", ros::init_options::NoSigintHandler);
  ros::NodeHandle keeps_ros_running;
  Player player(argv[2]);
  ros::AsyncSpinner spinner(1);
  spinner.start();
  player.run(std::cin, answers);
  _exit(0);    // all that is measured is over
}

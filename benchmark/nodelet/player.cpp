// Plays the rows of the table in C++: nodelets in one manager, or roscpp subscribers in the publisher's process.
// The commands are those of benchmark/player.py, which see.
#include <atomic>
#include <cstdio>
#include <ctime>
#include <iostream>
#include <map>
#include <memory>
#include <sstream>
#include <string>
#include <thread>
#include <unistd.h>
#include <vector>

#include <boost/make_shared.hpp>
#include <geometry_msgs/Twist.h>
#include <nodelet/loader.h>
#include <nodelet/nodelet.h>
#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <ros/spinner.h>
#include <sensor_msgs/Image.h>
#include <std_msgs/String.h>

namespace {

constexpr std::size_t STAMPS = 1 << 21;    // messages of a slice at the most
constexpr std::size_t SAMPLES = 4000;      // latencies told of a slice at the most
constexpr double PATIENCE = 10.0;          // seconds that connecting may take

double seconds_of(clockid_t which) {
  timespec now;
  clock_gettime(which, &now);
  return now.tv_sec + now.tv_nsec * 1e-9;
}
double now() { return seconds_of(CLOCK_MONOTONIC); }
double cpu() { return seconds_of(CLOCK_PROCESS_CPUTIME_ID); }
void pause(double seconds) { std::this_thread::sleep_for(std::chrono::duration<double>(seconds)); }

std::vector<double> sent(STAMPS);

// What the receivers noted; each writes into a vector of its own.
struct Notes {
  std::vector<float> took;
  std::atomic<std::size_t> count{0};
  Notes() : took(STAMPS) {}
  void note(std::size_t index) {
    const std::size_t at = count.load(std::memory_order_relaxed);
    if (at < STAMPS) {
      took[at] = now() - sent[index];
      count.store(at + 1, std::memory_order_release);
    }
  }
};

std::size_t index_of(const geometry_msgs::Twist& message) { return message.linear.x; }
std::size_t index_of(const std_msgs::String& message) { return std::stoul(message.data); }
std::size_t index_of(const sensor_msgs::Image& message) { return message.step; }
void mark(geometry_msgs::Twist& message, std::size_t index) { message.linear.x = index; }
void mark(std_msgs::String& message, std::size_t index) { message.data = std::to_string(index); }
void mark(sensor_msgs::Image& message, std::size_t index) { message.step = index; }

struct Setting {
  std::string kind, topic;
  unsigned receivers, queue_size;
};

// What is open: subscribers, and how to publish the message of an index.
struct Way {
  std::vector<std::unique_ptr<Notes>> notes;
  std::vector<ros::Subscriber> subscribers;
  ros::Publisher publisher;
  std::vector<boost::shared_ptr<sensor_msgs::Image>> images;    // a ring, longer than all queues: none is changed in use
  std::function<void(std::size_t)> prepare;                     // before the stamp, as the message is filled there too
  std::function<void()> publish;

  template <class M> void subscribe(ros::NodeHandle node, const Setting& setting) {
    notes.push_back(std::make_unique<Notes>());
    Notes* mine = notes.back().get();
    subscribers.push_back(node.subscribe<M>(
        setting.topic, setting.queue_size,
        boost::function<void(const boost::shared_ptr<const M>&)>(
            [mine](const boost::shared_ptr<const M>& message) { mine->note(index_of(*message)); })));
  }
  template <class M> void advertise(ros::NodeHandle node, const Setting& setting) {
    publisher = node.advertise<M>(setting.topic, setting.queue_size);
  }
};

template <class F> void with_type(const std::string& kind, F&& f) {
  if (kind == "twist") f(geometry_msgs::Twist());
  else if (kind == "string") f(std_msgs::String());
  else f(sensor_msgs::Image());
}

class Receiver : public nodelet::Nodelet {
 public:
  static Way* way;
  static Setting setting;
 private:
  void onInit() override {
    with_type(setting.kind, [this](auto message) { way->subscribe<decltype(message)>(getNodeHandle(), setting); });
  }
};
Way* Receiver::way;
Setting Receiver::setting;

class Sender : public nodelet::Nodelet {
  void onInit() override {
    with_type(Receiver::setting.kind, [this](auto message) {
      Receiver::way->advertise<decltype(message)>(getNodeHandle(), Receiver::setting);
    });
  }
};

boost::shared_ptr<nodelet::Nodelet> create(const std::string& type) {
  if (type == "receiver") return boost::make_shared<Receiver>();
  return boost::make_shared<Sender>();
}

class Player {
 public:
  Player(const std::string& name, bool nodelets) : name_(name), nodelets_(nodelets), loader_(boost::function<boost::shared_ptr<nodelet::Nodelet>(const std::string&)>(create)) {}

  void run(std::istream& commands, FILE* answers) {
    std::string line;
    while (std::getline(commands, line)) {
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
  Setting read(std::istream& words) {
    Setting setting;
    words >> setting.kind >> setting.receivers >> setting.queue_size;
    std::ostringstream topic;
    topic << "/" << name_ << "/" << setting.kind << "/" << setting.receivers << "/" << setting.queue_size;
    setting.topic = topic.str();
    for (char& letter : setting.topic) if (letter == '.') letter = '_';
    return setting;
  }

  void open(std::istream& words) {
    const Setting setting = read(words);
    Way& way = ways_[setting.topic];
    if (nodelets_) {
      Receiver::way = &way;
      Receiver::setting = setting;
      const std::string prefix = setting.topic + "/nodelet";
      for (unsigned i = 0; i < setting.receivers; ++i) loader_.load(prefix + std::to_string(i), "receiver", {}, {});
      loader_.load(prefix, "sender", {}, {});
    } else {
      if (!spinner_) {
        spinner_ = std::make_unique<ros::AsyncSpinner>(1, &queue_);
        spinner_->start();
      }
      with_type(setting.kind, [&](auto message) {
        using M = decltype(message);
        ros::NodeHandle receiving, sending;
        receiving.setCallbackQueue(&queue_);
        for (unsigned i = 0; i < setting.receivers; ++i) way.subscribe<M>(receiving, setting);
        way.advertise<M>(sending, setting);
      });
    }
    const double deadline = now() + PATIENCE;
    while (way.publisher.getNumSubscribers() < 1) {
      if (now() > deadline) throw std::runtime_error("not connected");
      pause(0.01);
    }
    fill(way, setting);
  }

  void fill(Way& way, const Setting& setting) {
    if (setting.kind.compare(0, 5, "image") != 0) {
      with_type(setting.kind, [&](auto message) {
        using M = decltype(message);
        auto next = std::make_shared<boost::shared_ptr<M>>();
        way.prepare = [next](std::size_t index) { *next = boost::make_shared<M>(); mark(**next, index); };
        way.publish = [next, &way] { way.publisher.publish(boost::shared_ptr<const M>(*next)); };
      });
      return;
    }
    const unsigned width = setting.kind == "image0.9" ? 640 : 1920, height = setting.kind == "image0.9" ? 480 : 1080;
    for (unsigned i = 0; i < setting.queue_size + 6; ++i) {
      auto image = boost::make_shared<sensor_msgs::Image>();
      image->width = width;
      image->height = height;
      image->encoding = "rgb8";
      image->data.resize(3 * width * height);
      way.images.push_back(image);
    }
    auto next = std::make_shared<std::size_t>(0);
    way.prepare = [next, &way](std::size_t index) {
      *next = index % way.images.size();
      mark(*way.images[*next], index);
    };
    way.publish = [next, &way] { way.publisher.publish(boost::shared_ptr<const sensor_msgs::Image>(way.images[*next])); };
  }

  void begin(std::istream& words) {
    way_ = &ways_.at(read(words).topic);
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
    while (index < STAMPS) {
      way_->prepare(index);
      const double stamp = sent[index] = now();
      way_->publish();
      ++index;
      if (rate == 0) {
        if (stamp > begun + seconds) break;
        continue;
      }
      due += 1 / rate;
      if (busy) while (now() < due) {}
      else pause(std::max(0.0, due - now()));
      if (index >= static_cast<std::size_t>(rate * seconds)) break;
    }
    answer << "\"sent\": " << index << ", \"begun\": " << begun << ", \"took\": " << now() - begun;
  }

  void result(std::istream& words, std::ostream& answer) {
    std::size_t expected, arrived = 0;
    double silence;    // seconds without a message after which the rest is lost
    words >> expected >> silence;
    double last = now(), used = cpu();
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
  bool nodelets_;
  nodelet::Loader loader_;
  ros::CallbackQueue queue_;
  std::unique_ptr<ros::AsyncSpinner> spinner_;
  std::map<std::string, Way> ways_;
  Way* way_ = nullptr;
  double cpu_ = 0;
};

}  // namespace

int main(int argc, char** argv) {
  FILE* answers = fdopen(dup(1), "w");
  dup2(2, 1);    // what ROS prints is no answer
  const std::string way = argv[1], name = argv[2];
  ros::init(argc, argv, name + "_player", ros::init_options::NoSigintHandler);
  ros::NodeHandle keeps_ros_running;
  Player player(name, way == "nodelets");
  ros::AsyncSpinner spinner(1);
  spinner.start();
  player.run(std::cin, answers);
  _exit(0);    // all that is measured is over
}

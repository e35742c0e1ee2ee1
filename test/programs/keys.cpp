// Drives by keys, as turtle_teleop_key does, and leaves it to its C library when what it prints is
// written.
#include <ros/ros.h>
#include <roscpp/Empty.h>
#include <std_msgs/String.h>
#include <stdio.h>
#include <termios.h>
#include <unistd.h>

int main(int argc, char** argv) {
  ros::init(argc, argv, "keys");
  ros::NodeHandle node;
  ros::Publisher pressed = node.advertise<std_msgs::String>("pressed", 10);
  while (!pressed.getNumSubscribers()) ros::WallDuration(0.01).sleep();
  termios before, raw;
  tcgetattr(0, &before);
  raw = before;
  raw.c_lflag &= ~(ICANON | ECHO);
  raw.c_cc[VEOL] = 1;
  raw.c_cc[VEOF] = 2;
  tcsetattr(0, TCSANOW, &raw);
  puts("Reading from keyboard");
  char key;
  while (read(0, &key, 1) == 1 && key != 'q') {
    printf("pressed %c\n", key);
    std_msgs::String message;
    message.data = key;
    pressed.publish(message);
  }
  tcsetattr(0, TCSANOW, &before);
  return 3;
}

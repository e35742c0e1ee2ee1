"""rospy programs and launch files, unmodified, as nodes of this process; loaded only when used.

- programs: finds a program, as rosrun does
- script: ScriptNode, a program as a node
- launch_file: a launch file, as roslaunch reads it, and which of its nodes run here
- composition: Composition, the nodes of a launch file; kept_node: one of them, started again where
  that is asked for
- apart: what runs in processes of its own; apart_program: roslaunch, which runs most of it
- output: where what programs print goes
- container: the services of a nodelet manager, which load and unload programs
- progress: what is said of all that on the screen

It stands on the facade.
"""

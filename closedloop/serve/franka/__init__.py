"""The interface of Franka's arms, robot server version 10: libfranka from 0.18 on connects to it as to an arm.

`server` answers commands and drives the simulation; `wire` has the messages, `arm` what the controller knows of the
arm, and its URDF for the client, `generator` the motion generators and controllers inside the arm, and what ends a
motion, `gripper` the hand. What is emulated and what is not is in docs/franka.md.
"""

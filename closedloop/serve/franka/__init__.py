"""The interface of Franka's arms, robot server version 10: libfranka from 0.18 on connects to it as to an arm.

`server` answers commands, drives the simulation and has the hand; `wire` has the messages, `generator` what the
controller knows of the arm, its motion generators, and what ends a motion. docs/franka.md says what is not emulated.
"""

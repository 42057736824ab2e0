"""Logs of other programs: ROS bags, MCAP and MATLAB files as logs of hydrotele, and logs as MCAP files."""

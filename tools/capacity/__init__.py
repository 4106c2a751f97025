"""`make capacity`: a simulation of nodes, cameras and failures, and the measurements that it is checked against."""

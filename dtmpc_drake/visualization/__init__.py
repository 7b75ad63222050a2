from dtmpc_drake.visualization.replay import write_replay

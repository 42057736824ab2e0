"""Examples and explanations that the help of a command prints below its options."""

COMPARE_EPILOG = """\b
Examples:  hydrotele compare cat215 gap_site_a --data measured/site_a
           hydrotele compare ec20 --data long.parquet --baseline table --baseline mlp --out compared
           hydrotele compare cat215 --data logs --heldout run_7 --horizons 2,20 --json

\b
Each model predicts a held-out run, which was not used to fit it. The prediction starts at many rows
of the log, from the state estimated there. It then uses only the commands (open-loop prediction)
and is compared with the measurements. The one-step error, from one row to the next, is listed as
well. Horizons longer than the run are omitted.

\b
A result folder of gap with posterior.parquet also gets a 95 % prediction band, from machines sampled
from the posterior. The band contains parameter uncertainty and measurement noise, but not missing effects:
about 95 % of the readings are inside if the model is complete. Far fewer suggest a missing effect.

\b
Black-box models, fitted on the other runs (--baseline, repeatable):
  table   delay and static table from command to speed, for each axis
  arx     linear model with past measurements and commands as inputs
  mlp     neural network with the same inputs; needs pip install 'hydrotele[baselines]'
"""

DRIVE_EPILOG = """\b
Examples:  hydrotele drive   |   hydrotele drive fell_tree --device gamepad
           hydrotele drive --device scripted:moves.csv --no-viewer --speed 0
           hydrotele drive --device haptic:127.0.0.1:5610   |   hydrotele drive --latency
           hydrotele drive --web --port 8080    # in a browser, needs pip install 'hydrotele[web]'

\b
Keyboard: each key press changes the command of an axis by a quarter of its maximum. The command
then stays constant; the space bar sets all commands to zero.
  Up, Down: out, in        Left, Right: swing    Page Up, Page Down: raise, lower
  End, Home: curl in, out  Insert, Delete: turn the head
  7, 6: command of the first additional axis (such as the grab) up, down
  9, 8: command of the second additional axis (such as the saw) up, down
  F10, Ctrl-C or closing the window: stop and write the logs

\b
Gamepad: the left stick moves the tip out and in and swings; the right stick raises and lowers the tip
and turns the tool. The shoulder buttons turn the head, the direction pad moves additional axes. B sets
all commands to zero, Start stops the run.

\b
SpaceMouse: push the cap in the direction in which the tip must move. Its two buttons switch the first
two additional axes; both together set all commands to zero.

\b
--device haptic:HOST:PORT: a joystick with motors, on the computer HOST, on which hydrotele
haptic-device runs. The force reflection runs at 1 kHz, separately from the simulation of the machine.
--latency prints delays and missed deadlines; without --device it starts a simulated device for 60 s.

\b
--web: a page with the machine, two joysticks, forces and pressures. It reads keyboard and gamepad.
One page drives, others watch. All commands become zero if the page that drives sends nothing for
0.5 s. Only this computer can open the page. For another computer forward the port with
ssh -L 8080:127.0.0.1:8080 SERVER, or give --host 0.0.0.0, which lets everyone in the network drive.
"""

SWEEP_EPILOG = """\b
Examples:  hydrotele sweep servo_gains   |   hydrotele sweep my_sweep.yaml --jobs 8 --out runs/a
           hydrotele sweep my_sweep.yaml --dask tcp://10.0.0.5:8786

\b
A sweep file:
  scenario: zhu_up                                  # shipped, or a file in the same folder
  set: {effects: [{name: payload, location: tool, parameters: {mass: 0}}]}
  grid: {servo.position_gain: [3, 4, 5]}            # keys as in run --set; all combinations
  sample:                                           # combined with each point of the grid
    count: 20
    seed: 1
    keys: {effects.0.parameters.mass: {uniform: [0, 1500]}}   # log_uniform, normal, choice
  repeat: 2                                         # with successive seeds of the scenario
  figures: [tracking.tip_z.rms, max_pin_opening_mm]       # plotted; default: a selection
  logs: false                                       # true: keep the folder of each run

\b
After an interruption (Ctrl-C, kill), the same command continues with the missing runs. Failed runs
are listed and appear in the table with the reason; --retry-failed repeats them. The exit status is 3
if all runs failed, otherwise 0; with --strict it is 3 if any run failed.
"""

IMPORT_EPILOG = """\b
Examples:  hydrotele import field.mcap --write-mapping field.yaml --machine my_excavator
           hydrotele import field.mcap --mapping field.yaml --machine my_excavator --out logs
           hydrotele import bag_folder sensors.mat --merge --mapping both.yaml --out run_1.parquet

\b
The command reads ROS 1 bags (.bag), ROS 2 bags (folder, .db3, .mcap), plain MCAP, MATLAB files
(.mat), CSV dialects and Parquet. Bags and MATLAB 7.3 need pip install 'hydrotele[import]'.

\b
A mapping states the channel of each column or topic, and how its values are converted. It is the
key `log_columns` of the machine file, of log_columns.yaml next to the log, or of --mapping.
"""

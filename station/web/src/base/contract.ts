// The contract's constants and types. Generated: `make docs-parts` fills it.
// [[[cog page_contract() ]]]
export const SCHEMA_VERSION = 1;
export const MAX_FIELDS = 512;
export const MAX_NEXT_MS = 100000;
export const STALE_S = 1.5;
export const GONE_S = 4.5;
export const LIVE_MAX_RATE_HZ = 10.0;
export const NAME = /^(?:[A-Za-z0-9_-]{1,64})$/;
export const LIVE = "live";
export const VIEW = "view";
export const CMD = "cmd";
export const BOOT = /^(?:[0-9a-f]{8,32})$/;
export const FIELD_NAME = /^(?:[A-Za-z][A-Za-z0-9_]*(\.[A-Za-z0-9_]+)*)$/;
export const TACHOMETER_COUNTS = 6;
export const ANALYSIS_FAILED = "analysis_failed";
export const MAX_LEASE_MS = 10000;
export const DRIVE_RATE_HZ = 20.0;
export const DRIVE_LEASE_MS = 500;
export const DRIVE_MAX_RTT_MS = 500;
export const DRIVE_MAX_AGE_MS = 1000;
export const DRIVE_MARGIN_MS = 50;
export const DRIVE_ANSWER_MS = 2000;
export const DRIVE_ENDS = 3;
export const DRIVE_CORRECTIONS = 2;
export const DRIVE_CLOCK_KEPT_MS = 60000;
export const LOST = ["driven_by_another", "emergency_stop", "begin_again", "from_an_earlier_session", "shutting_down"];
export const UNTIMELY = ["stale", "lease_over", "from_the_future"];
export const MAX_NOTE_CHARACTERS = 500;
export const LEASE = "lease";
export const VIEW_LEASE_MS = 15000;
export const VIEW_RENEW_S = 5.0;
export const PICTURE_MAX_AGE_MS = 500;
export const MAX_SDP_BYTES = 32768;
export const CHANNEL = "frames";
export const ECHO_EVERY_MS = 1000;
export const ECHO_KEPT_MS = 30000;
export const VIDEO = "video";
export const PICTURE = "picture";
export const TO = "to-";
export const KEY_HEADER = "X-Iort-Key";
export const INVITATION = "key";
export const LOG_STREAM = "log";
export const DRIVE_STREAM = "drive";
export const INCIDENT_STREAM = "incidents";
export const REFUSALS = {
  "driven_by_another": "another session drives; begin a new one that takes over",
  "emergency_stop": "the robot is stopped until somebody releases it",
  "begin_again": "this session was refused before, or a stop ended it; let go, and begin a new one",
  "from_an_earlier_session": "a later session has driven since",
  "repeated_or_out_of_order": "a later command of the session has passed",
  "settings_unknown": "the robot has just connected, and does not know yet whether it must stand still",
  "clock_offset_unknown": "the robot does not know the cloud's time yet",
  "lease_over": "the command's lease had ended when it came, or the robot was stopped after it was sent",
  "stale": "the command was too old when it came",
  "from_the_future": "the command's time lies in the future: the sender's clock is wrong",
  "without_lease": "a motion needs `lease_ms`",
  "guard_not_ready": "the process that stops the robot if the agent dies is not running yet",
  "no_ros": "the agent is not in the ROS graph",
  "no_picture": "the command names no picture: drive on the page by its picture, or say that you drive blind",
  "picture_late": "the driver's picture was too old when the command came",
  "shutting_down": "the agent is ending"
} as const;
export const TEMPERATURES = ["temperature_pcb", "temp_fet", "temp_motor", "ntc_temp_mos1", "ntc_temp_mos2", "ntc_temp_mos3"] as const;
export const ATTACHMENT_PARTS = ["key", "sha256", "size", "content_type", "thumbnail"] as const;
export const ABSENT_FROM: Readonly<Record<string, number>> = {"temperature_pcb": -50.0, "temp_fet": -50.0, "temp_motor": -50.0, "ntc_temp_mos1": -50.0, "ntc_temp_mos2": -50.0, "ntc_temp_mos3": -50.0};
export const CAR_ALARMS = {
  "FaultSamples": {
    "meaning": "a car reports a fault",
    "advice": "stop it and look; `iort query` with a condition on `fault_code` finds the car"
  },
  "TemperatureDegC": {
    "meaning": "a car's controller is hot",
    "advice": "let it cool; a VESC throttles by itself from 85 degC"
  },
  "BatteryVolts": {
    "meaning": "a car's battery is low",
    "advice": "change it: a lithium cell below 3 V is damaged"
  }
} as const;
/** speed of the car, m/s */
export const speed_mps = (speed: number, speed_to_erpm_gain: number, speed_to_erpm_offset: number): number => (speed - speed_to_erpm_offset) / speed_to_erpm_gain;
/** electrical power from the battery, negative while regenerating, W */
export const power_w = (voltage_input: number, current_input: number): number => voltage_input * current_input;
export const FIELD_TABLE: FieldTable = {
  "version": 1,
  "stream": "vesc",
  "fields": {
    "voltage_input": { "unit": "V", "meaning": "battery voltage at the controller", "label": "Battery voltage" },
    "temperature_pcb": { "unit": "degC", "meaning": "temperature of the controller's board", "label": "Board temperature" },
    "temp_fet": { "unit": "degC", "meaning": "temperature of the MOSFETs (driver may leave 0)" },
    "temp_motor": { "unit": "degC", "meaning": "temperature of the motor (driver may leave 0)" },
    "current_motor": { "unit": "A", "meaning": "motor current, negative while braking", "label": "Motor current" },
    "current_input": { "unit": "A", "meaning": "battery current, negative while regenerating", "label": "Battery current" },
    "avg_id": { "unit": "A", "meaning": "direct-axis current" },
    "avg_iq": { "unit": "A", "meaning": "quadrature-axis current" },
    "speed": { "unit": "erpm", "meaning": "electrical speed of the motor, revolutions per minute" },
    "duty_cycle": { "unit": "1", "meaning": "share of the battery voltage on the motor, -1 to 1" },
    "charge_drawn": { "unit": "1e-4 Ah", "meaning": "charge drawn since power-on", "ros2_unit": "Ah" },
    "charge_regen": { "unit": "1e-4 Ah", "meaning": "charge recovered since power-on", "ros2_unit": "Ah" },
    "energy_drawn": { "unit": "1e-4 Wh", "meaning": "energy drawn since power-on", "ros2_unit": "Wh" },
    "energy_regen": { "unit": "1e-4 Wh", "meaning": "energy recovered since power-on", "ros2_unit": "Wh" },
    "displacement": { "unit": "counts", "meaning": "tachometer, net" },
    "distance_traveled": { "unit": "counts", "meaning": "tachometer, absolute" },
    "fault_code": { "unit": "enum", "meaning": "0 none, otherwise see FAULTS" },
    "pid_pos_now": { "unit": "deg", "meaning": "rotor position of the position controller" },
    "controller_id": { "unit": "id", "meaning": "CAN id of the controller" },
    "ntc_temp_mos1": { "unit": "degC", "meaning": "temperature of MOSFET 1" },
    "ntc_temp_mos2": { "unit": "degC", "meaning": "temperature of MOSFET 2" },
    "ntc_temp_mos3": { "unit": "degC", "meaning": "temperature of MOSFET 3" },
    "avg_vd": { "unit": "V", "meaning": "direct-axis voltage" },
    "avg_vq": { "unit": "V", "meaning": "quadrature-axis voltage" },
    "broker_ms": { "unit": "ms", "meaning": "round trip over the path broker" },
    "rule_ms": { "unit": "ms", "meaning": "round trip over the path rule" },
    "lambda_ms": { "unit": "ms", "meaning": "round trip over the path lambda" },
    "cpu_percent": { "unit": "%", "meaning": "share of one core, since the sample before", "label": "Processor" },
    "rss_mb": { "unit": "MB", "meaning": "memory in use", "label": "Memory" },
    "samples_per_s": { "unit": "samples/s", "meaning": "samples from all sources, since the sample before" },
    "backlog_batches": { "unit": "batches", "meaning": "batches in the spool" },
    "backlog_bytes": { "unit": "bytes", "meaning": "bytes in the spool" },
    "dropped_batches": { "unit": "batches", "meaning": "batches dropped because the spool was full" },
    "connects": { "unit": "connections", "meaning": "connections made" },
    "clock_offset_ms": { "unit": "ms", "meaning": "cloud's clock minus the car's; null before the first pong" },
    "clock_uncertainty_ms": { "unit": "ms", "meaning": "uncertainty of the clock offset, either way" },
    "files_waiting": { "unit": "files", "meaning": "files waiting to be uploaded" },
    "files_sent_bytes": { "unit": "bytes", "meaning": "bytes of files sent", "label": "Files sent" },
    "thread_errors": { "unit": "errors", "meaning": "errors of the agent's threads, since the sample before" },
    "frame": { "unit": "", "meaning": "the picture's number in this run of the agent", "label": "Picture" },
    "bytes": { "unit": "bytes", "meaning": "size of the encoded picture; the JPEG's if nobody had WebRTC" },
    "key": { "unit": "", "meaning": "whether the picture needs no other one" },
    "encode_ms": { "unit": "ms", "meaning": "from the capture to the encoded picture", "label": "Encoding" },
    "bitrate_kbps": { "unit": "kbit/s", "meaning": "the bitrate that the encoder aimed at", "label": "Bitrate" },
    "viewers": { "unit": "viewers", "meaning": "viewers by WebRTC" },
    "watchers": { "unit": "viewers", "meaning": "viewers of pictures over the broker" },
    "speed_mps": { "unit": "m/s", "meaning": "speed of the car", "label": "Speed" },
    "power_w": { "unit": "W", "meaning": "electrical power from the battery, negative while regenerating", "label": "Battery power" }
  },
  "streams": {
    "pose": {
      "x": { "unit": "m", "meaning": "position of the rear axle's middle" },
      "y": { "unit": "m", "meaning": "position of the rear axle's middle" },
      "heading": { "unit": "rad", "meaning": "direction of travel: 0 along x, pi/2 along y, -pi to pi" }
    },
    "log": {
      "level": { "unit": "", "meaning": "`warning`, `error` or `critical`" },
      "logger": { "unit": "", "meaning": "the part of the agent, such as `iort_agent.mqtt.aws`" },
      "text": { "unit": "", "meaning": "the line, with the exception's if it has one; at most 1,000 characters" },
      "left_out": { "unit": "lines", "meaning": "lines that were too many to send, since the line before" }
    },
    "drive": {
      "session": { "unit": "", "meaning": "the operator's session that sent the command" },
      "by": { "unit": "", "meaning": "who sent it, as they say; null if they do not" },
      "seq": { "unit": "", "meaning": "the command's number in its session", "label": "Command" },
      "sent_us": { "unit": "us", "meaning": "when it was sent, by the cloud's clock", "label": "Sent at" },
      "outcome": { "unit": "", "meaning": "`accepted`, or why it was refused; `stopped` when the robot was stopped after it" },
      "driver": { "unit": "", "meaning": "the session that drives now; null if none does" },
      "driver_by": { "unit": "", "meaning": "who drives now" },
      "lease_left_ms": { "unit": "ms", "meaning": "how long the driver's lease still holds", "label": "Lease left" },
      "speed": { "unit": "m/s", "meaning": "the speed that the robot was told; null if refused", "label": "Speed asked for" },
      "steering": { "unit": "rad", "meaning": "the steering angle that it was told", "label": "Steering asked for" },
      "frame": { "unit": "", "meaning": "the newest picture on the driver's screen; null if the command names none" },
      "frame_age_ms": { "unit": "ms", "meaning": "age of that picture when the command came; null if the robot does not know the picture", "label": "Picture's age" },
      "blind": { "unit": "", "meaning": "whether the driver said that he drives without a picture" }
    },
    "incidents": {
      "id": { "unit": "", "meaning": "the incident, in hexadecimal" },
      "trigger": { "unit": "", "meaning": "the triggers that fired, with commas; `take` for an operator's" },
      "condition": { "unit": "", "meaning": "the condition of the first of them" },
      "why": { "unit": "", "meaning": "the values at the edge, the operator's reason, or why nothing is kept" },
      "from_us": { "unit": "us", "meaning": "the begin of the window", "label": "From" },
      "to_us": { "unit": "us", "meaning": "the end of the window", "label": "To" },
      "state": { "unit": "", "meaning": "`kept` on the robot, `uploaded`, `notified` (only told), `over_budget`, or `lost`" },
      "key": { "unit": "", "meaning": "the file in the bucket; empty before it is there", "label": "File" },
      "bytes": { "unit": "bytes", "meaning": "the size of the file", "label": "Size" },
      "messages": { "unit": "messages", "meaning": "messages in the file" },
      "missing": { "unit": "messages", "meaning": "messages of the window that are known not to be in the file" },
      "by": { "unit": "", "meaning": "the operator who took it, as they say" }
    }
  },
  "ros_units": {
    "linear_acceleration": "m/s^2",
    "angular_velocity": "rad/s",
    "twist.linear": "m/s",
    "twist.angular": "rad/s",
    "position": "m",
    "translation": "m"
  },
  "faults": {
    "0": "none",
    "1": "over voltage",
    "2": "under voltage",
    "3": "gate driver (DRV8302)",
    "4": "absolute over-current",
    "5": "MOSFET over-temperature",
    "6": "motor over-temperature",
    "7": "gate driver over voltage",
    "8": "gate driver under voltage",
    "9": "controller under voltage",
    "10": "booting from a watchdog reset",
    "11": "encoder SPI",
    "12": "sin/cos encoder below its minimum amplitude",
    "13": "sin/cos encoder above its maximum amplitude",
    "14": "flash corruption",
    "15": "high offset of current sensor 1",
    "16": "high offset of current sensor 2",
    "17": "high offset of current sensor 3",
    "18": "unbalanced currents",
    "19": "hardware brake input",
    "20": "resolver, loss of tracking",
    "21": "resolver, degradation of signal",
    "22": "resolver, loss of signal",
    "23": "flash corruption, application configuration",
    "24": "flash corruption, motor configuration",
    "25": "encoder without magnet",
    "26": "encoder magnet too strong",
    "27": "phase filter",
    "28": "encoder fault",
    "29": "low-voltage output",
    "30": "encoder slip",
    "31": "overspeed",
    "32": "underspeed",
    "33": "absolute overspeed"
  }
};

export interface FieldEntry {
  readonly unit: string;
  readonly ros2_unit?: string;
  readonly meaning: string;
  /** What the page calls it, unless its name says it. */
  readonly label?: string;
}

export interface FieldTable {
  /** The schema version; messages of another version are refused. */
  readonly version: number;
  /** The stream with the VESC's fields. */
  readonly stream: string;
  readonly fields: Readonly<Record<string, FieldEntry>>;
  /** Stream -> its fields, whose names mean something else elsewhere. */
  readonly streams: Readonly<Record<string, Readonly<Record<string, FieldEntry>>>>;
  /** Field -> unit of the fields x, y and z within it. */
  readonly ros_units: Readonly<Record<string, string>>;
  readonly faults: Readonly<Record<string, string>>;
}

export type Value = null | boolean | number | string;

/** From the first sample to the time just after the last one, in microseconds since the epoch. */
export interface Extent {
  readonly from_us: number;
  readonly to_us: number;
}

/** A value with its interval, which holds the truth in nine of ten cases. */
export interface EstimateEntry {
  readonly value: number;
  readonly low: number;
  readonly high: number;
  readonly unit: string;
}

/** A parameter of the catalogue. */
export interface ParameterEntry {
  readonly unit: string;
  readonly meaning: string;
  readonly worse: "up" | "down" | "either";
}

/** A finding of the analysis, with its kind's entry in the catalogue. ``start_us`` is the drive's start, the extent that of the evidence. ``effect`` is the change from ``baseline``, or the size of an event. ``q`` is the false discovery rate; null if no test was made. */
export interface FindingEntry {
  readonly from_us: number;
  readonly to_us: number;
  readonly id: string;
  readonly robot: string;
  readonly start_us: number;
  readonly kind: string;
  readonly severity: "info" | "warning" | "serious";
  readonly meaning: string;
  readonly action: string;
  readonly subject: string;
  readonly stream: string;
  readonly fields: readonly string[];
  readonly text: string;
  readonly effect: EstimateEntry | null;
  readonly baseline: EstimateEntry | null;
  readonly q: number | null;
}

/** An analysed drive. ``failed`` is the reason if it could not be analysed, ``missing`` that of each parameter that could not be computed, ``repairs`` counts what was cleaned. */
export interface DriveEntry {
  readonly from_us: number;
  readonly to_us: number;
  readonly robot: string;
  readonly samples: number;
  readonly failed: string;
  readonly repairs: Readonly<Record<string, number>>;
  readonly estimates: Readonly<Record<string, EstimateEntry>>;
  readonly missing: Readonly<Record<string, string>>;
}

/** Answers ``insights``: the findings and the drives of a robot or of the fleet, the newest first. ``groups`` has the parameters in the order in which a person reads them. */
export interface InsightsAnswer {
  readonly findings: readonly FindingEntry[];
  readonly drives: readonly DriveEntry[];
  readonly groups: Readonly<Record<string, Readonly<Record<string, ParameterEntry>>>>;
}

/** What ``by`` wrote about a robot at a time. */
export interface NoteEntry {
  readonly id: string;
  readonly robot: string;
  readonly t_us: number;
  readonly text: string;
  readonly by: string;
}

/** Answers ``notes``, ``note`` and ``delete_note``: notes about a robot or the fleet, the newest first. */
export interface NotesAnswer {
  readonly notes: readonly NoteEntry[];
}

/** What a robot's recorder has kept of a time: `iort_contract.messages.recorder.Incident` in its newest state. Its file can be downloaded once ``state`` is "uploaded". */
export interface IncidentEntry {
  readonly from_us: number;
  readonly to_us: number;
  readonly id: string;
  readonly robot: string;
  readonly trigger: string;
  readonly state: string;
  readonly condition: string;
  readonly why: string;
  readonly by: string;
  readonly bytes: number;
  readonly messages: number;
  readonly missing: number;
}

/** Answers ``incidents``: those of a robot, the newest first; ``found`` may exceed their number. */
export interface IncidentsAnswer {
  readonly incidents: readonly IncidentEntry[];
  readonly found: number;
}

/** Answers ``incident_picture``: what its file shows. ``jpeg``, in base64, is the image of ``topic`` nearest to the edge, ``after_s`` later. Without an image they are empty, and ``field`` has ``values`` at ``times_s`` after the edge; without those, it is empty too. */
export interface IncidentPicture {
  readonly jpeg: string;
  readonly topic: string;
  readonly after_s: number;
  readonly field: string;
  readonly times_s: readonly number[];
  readonly values: readonly number[];
}

/** Answers ``incident_counts``: how many incidents of the last day each robot has, if it has any. */
export interface IncidentCounts {
  readonly counts: Readonly<Record<string, number>>;
}

/** Answers ``keep`` and ``add_trigger``: the robot's answer; null if it did not give one. ``reason`` says why it refused. */
export interface KeepAnswer {
  readonly accepted: boolean | null;
  readonly reason: string;
  readonly online: boolean;
}

/** Answers ``analyse``: the run of the analysis. */
export interface AnalysisStarted {
  readonly run: string;
}

/** Answers ``analysis``: how far a run is. ``drives`` is null until they are found. */
export interface AnalysisAnswer {
  readonly running: boolean;
  readonly drives: number | null;
  readonly done: number;
}

/** A lap; null for what is not known. ``complete`` is false if it does not fit the others. */
export interface Lap {
  readonly from_us: number;
  readonly to_us: number;
  readonly lap: number;
  readonly time_s: number;
  readonly distance_m: number | null;
  readonly energy_wh: number | null;
  readonly energy_wh_per_km: number | null;
  readonly mean_speed_mps: number | null;
  readonly top_speed_mps: number | null;
  readonly complete: boolean;
  readonly best: boolean;
}

/** Answers ``laps``: those of a robot in a range. ``method`` is "gate" or "pattern", and empty without laps, for the ``reason`` given. ``estimates`` has the best and the mean. */
export interface LapsAnswer {
  readonly laps: readonly Lap[];
  readonly method: string;
  readonly confidence: number;
  readonly reason: string;
  readonly estimates: Readonly<Record<string, EstimateEntry>>;
}

/** Answers ``delta``: how far lap ``other`` is behind lap ``one`` at each place, and their speeds. Places are in metres; in shares of the lap if its length is not known, and then the speeds are null. */
export interface DeltaAnswer {
  readonly places: readonly number[];
  readonly unit: "m" | "%";
  readonly delta_s: readonly number[];
  readonly one_mps: readonly (number | null)[];
  readonly other_mps: readonly (number | null)[];
}

/** A closed track's centre line and its widths to either side: `iort_contract.track.Track`. */
export interface TrackMap {
  readonly x_m: readonly number[];
  readonly y_m: readonly number[];
  readonly w_right_m: readonly number[];
  readonly w_left_m: readonly number[];
}

/** The identity that everybody gets, of an Amazon Cognito identity ``pool``, from ``endpoint``. Its credentials sign ``socket``, the broker's address, for the service iotdevicegateway. Client ids begin with ``client_prefix``. It hears ``robots``, or all of them if there are none; it publishes nothing. */
export interface Identity {
  readonly pool: string;
  readonly region: string;
  readonly endpoint: string;
  readonly socket: string;
  readonly client_prefix: string;
  readonly robots: readonly string[];
}

/** ``config.json``: where to listen. ``live`` is ``pubnub``, by ``subscribe_key`` at ``origin``; or ``iot``, by addresses of the server's answer ``socket``, or of a static site's ``identity``. ``drivers`` says whether the action ``drive`` gives addresses that may send commands. ``token`` is PubNub's access token, or empty. ``answers`` says whether the server answers questions about the past; a static site does not. ``actions`` names what the server changes when it is asked; those in ``keyed`` need its key, which is a new one at every start: see `Admitted`. ``invite`` is the command, for who serves the page, whose link gives one more browser the key; empty if there is none. ``vehicles`` maps a robot to its `Vehicle`'s parameters. ``track`` is the track that the cars drive on, if it is known. */
export interface Config {
  readonly namespace: string;
  readonly live: "pubnub" | "iot";
  readonly identity: Identity | null;
  readonly drivers: boolean;
  readonly subscribe_key: string;
  readonly origin: string;
  readonly tls: boolean;
  readonly token: string;
  readonly answers: boolean;
  readonly actions: readonly string[];
  readonly keyed: readonly string[];
  readonly invite: string;
  readonly vehicles: Readonly<Record<string, Readonly<Record<string, number>>>>;
  readonly track: TrackMap | null;
}

/** Answers ``socket``, for a viewer, and the action ``drive``, for a driver: an address of the broker, to be opened within 5 minutes, and the client id for the connection. */
export interface SocketAnswer {
  readonly url: string;
  readonly client_id: string;
}

/** A STUN or TURN server, as a browser takes it; ``username`` and ``credential`` are a TURN server's. */
export interface IceServerEntry {
  readonly urls: readonly string[];
  readonly username: string;
  readonly credential: string;
}

/** Answers ``ice``: the deployment's servers for video by WebRTC, for a session that begins now; none without the setting ``turn``. Their credentials end within minutes, so ask before each offer. */
export interface IceAnswer {
  readonly ice_servers: readonly IceServerEntry[];
}

/** Answers ``key``, once for each token; or again for the key itself. */
export interface Admitted {
  readonly key: string;
}

/** Answers ``view``: of how many robots a live lane was asked for. */
export interface ViewAnswer {
  readonly asked: number;
}

/** Whether a robot is connected, and since when it is or is not; null if it never was. */
export interface RobotPresence {
  readonly online: boolean;
  readonly since_ms: number | null;
}

/** Answers ``robots``. */
export interface RobotsAnswer {
  readonly robots: Readonly<Record<string, RobotPresence>>;
}

/** Answers ``tags``: each robot's tags, which are the attributes of its thing. */
export interface TagsAnswer {
  readonly tags: Readonly<Record<string, Readonly<Record<string, string>>>>;
}

/** Answers ``vehicles``: as in `Config`. */
export interface VehiclesAnswer {
  readonly vehicles: Readonly<Record<string, Readonly<Record<string, number>>>>;
}

/** Answers ``streams``: the names of a robot's streams. */
export interface StreamsAnswer {
  readonly streams: readonly string[];
}

/** The fields of a stream with numbers, by its newest samples, and those of its ``position``: x and y in metres, or latitude and longitude in ``degrees``; none without a position. */
export interface StreamFields {
  readonly numbers: readonly string[];
  readonly position: readonly string[];
  readonly degrees: boolean;
}

/** Answers ``fields``: those of each stream of a robot. */
export interface FieldsAnswer {
  readonly streams: Readonly<Record<string, StreamFields>>;
}

/** Answers ``raceline``: the closed line of least curvature on the page's track, and the time of a lap of the default car; without points for the ``reason`` given. */
export interface RacelineAnswer {
  readonly x_m: readonly number[];
  readonly y_m: readonly number[];
  readonly lap_s: number;
  readonly reason: string;
}

/** A trigger that a robot's event recorder is to have: its condition, or what else fires it, beside the robot's ``answer``: "accepted", why not, or nothing yet. With ``notify`` it tells, and keeps nothing. */
export interface TriggerEntry {
  readonly name: string;
  readonly stream: string;
  readonly when: string;
  readonly cooldown_s: number;
  readonly notify: boolean;
  readonly answer: string;
}

/** Answers ``triggers`` and ``remove_trigger``: those of a robot. */
export interface TriggersAnswer {
  readonly triggers: readonly TriggerEntry[];
}

/** Answers ``dry_run``: how often a condition became true in the ``samples`` of a range, and how many incidents would have told of it, after cooldown and merge; with the first ``times_s``. */
export interface DryRunAnswer {
  readonly edges: number;
  readonly told: number;
  readonly samples: number;
  readonly times_s: readonly number[];
}

/** What a run recorded of a stream. ``batches`` is how many it numbered. ``samples`` is how many the agent counted, up to its last report; null without a report. */
export interface RunPart {
  readonly from_us: number;
  readonly to_us: number;
  readonly batches: number;
  readonly samples: number | null;
}

/** A run of a robot's agent, from its start to its end. ``run`` is its name in batch ids. ``state`` is "cut off" if it did not end properly, and "unknown" without a report of the agent, or if it goes on after the range. ``lost`` counts the messages and samples that the agent reports as not recorded. ``streams`` is empty if nothing was recorded. */
export interface Run {
  readonly from_us: number;
  readonly to_us: number;
  readonly run: string;
  readonly state: "running" | "ended" | "cut off" | "unknown";
  readonly lost: number;
  readonly streams: Readonly<Record<string, RunPart>>;
}

/** Answers ``runs``: the runs of a robot's agent, newest first. ``older`` tells whether there are more; ask for those before the last one's ``from_us``. ``streams`` has the extent of all that is stored. */
export interface RunsAnswer {
  readonly runs: readonly Run[];
  readonly older: boolean;
  readonly streams: Readonly<Record<string, Extent>>;
}

/** Answers ``dashboards``: their names. */
export interface DashboardsAnswer {
  readonly dashboards: readonly string[];
}

/** What values a setting has. */
export interface SettingKind {
  readonly kind: "flag" | "number" | "choice" | "fields";
  readonly low: number;
  readonly high: number;
  readonly unit: string;
  readonly names: readonly string[];
}

/** A setting of a running agent. ``low``, ``high`` and ``unit`` are a number's, ``names`` a choice's. ``value`` is in force, as text, and empty if the agent has not reported it. ``desired`` tells whether it was changed from here, so that car.yaml's value can return. ``pending`` is the value that the agent has not taken yet: null if it took the last one, and empty if it shall send all fields. ``reason`` says why it rejected the last one. */
export interface SettingEntry {
  readonly kind: "flag" | "number" | "choice" | "fields";
  readonly low: number;
  readonly high: number;
  readonly unit: string;
  readonly names: readonly string[];
  readonly name: string;
  readonly value: string;
  readonly desired: boolean;
  readonly pending: string | null;
  readonly reason: string;
}

/** Answers ``settings`` and ``set``. */
export interface SettingsAnswer {
  readonly settings: readonly SettingEntry[];
  readonly online: boolean;
}

/** What a stick drives, and how far: `iort_contract.messages.commands.DriveLimits`. */
export interface DriveLimitsEntry {
  readonly command: string;
  readonly speed: string;
  readonly steering: string;
  readonly max_speed_mps: number;
  readonly max_steering_rad: number;
  readonly lease_ms: number;
}

/** What a robot's camera can show: `iort_contract.messages.video.VideoTerms`. It takes no motion by a picture that is older than ``max_age_ms``. */
export interface VideoTermsEntry {
  readonly width: number;
  readonly height: number;
  readonly rate_hz: number;
  readonly max_age_ms: number;
}

/** Whether a robot may move. ``asked`` is the emergency stop as it was last asked for here or elsewhere, unless the robot rejected it; ``stopped`` as the robot has confirmed it, null before it does. ``reason`` says why it rejected a stop or a release. ``stands``: by the robot's own word it takes no motion by command until it is released. ``stoppable``: whether a stop ends its motion; false if nothing that moves it can be stopped from here, null before it has said so. ``why_not`` is for a human, empty if it is stoppable. ``alone``: the release of the fleet does not end this stop. ``by`` is who asked for the stop, or else released the robot last, at ``at_ms``; empty if unknown. ``drive`` is null if a stick cannot drive it, ``video`` if it has no camera to drive it by. */
export interface MotionEntry {
  readonly asked: boolean;
  readonly stopped: boolean | null;
  readonly reason: string;
  readonly stands: boolean;
  readonly stoppable: boolean | null;
  readonly why_not: string;
  readonly alone: boolean;
  readonly by: string;
  readonly at_ms: number;
  readonly drive: DriveLimitsEntry | null;
  readonly video: VideoTermsEntry | null;
}

/** Answers ``motion`` and ``stop``: each robot's. ``user`` is who drives if the viewer gives no name. ``failed`` has the reason for each robot whose stop could not be changed. */
export interface MotionAnswer {
  readonly robots: Readonly<Record<string, MotionEntry>>;
  readonly user: string;
  readonly failed: Readonly<Record<string, string>>;
}

/** Answers ``send``: null if the robot did not answer, with the reason if it is not connected; or its reason if it rejected the command. */
export interface SendAnswer {
  readonly accepted: boolean | null;
  readonly reason: string;
  readonly after_ms: number;
}

/** A field's values; with minimum and maximum if a row stands for many samples. */
export interface Column {
  readonly mean: readonly Value[];
  readonly least?: readonly Value[];
  readonly most?: readonly Value[];
}

/** The part of an answer that comes from the archive: the number of its hours, and the first and last of their times. */
export interface Archived {
  readonly from_us: number;
  readonly to_us: number;
  readonly hours: number;
}

/** Answers ``history``: a stream's samples in a range. ``row_s`` is the time that a row covers; 0 if each row is a sample. A position is that of the row's last sample. ``ros2`` says whether charge and energy have the ROS 2 driver's units. ``archive`` is null if all comes from the table. ``refused`` counts what is stored in the range and cannot be read; ``reason`` names the first by topic, time and error. */
export interface HistoryAnswer {
  readonly times_s: readonly number[];
  readonly fields: Readonly<Record<string, Column>>;
  readonly samples: number;
  readonly ros2: boolean;
  readonly row_s: number;
  readonly archive: Archived | null;
  readonly refused: number;
  readonly reason: string;
}

/** A line of a chart; ``right`` for the right axis. */
export interface Series {
  readonly label: string;
  readonly right: boolean;
  readonly times_s: readonly number[];
  readonly values: readonly number[];
}

/** A CloudWatch alarm. */
export interface Alarm {
  readonly name: string;
  readonly about: string;
  readonly state: "OK" | "ALARM" | "INSUFFICIENT_DATA";
  readonly reason: string;
  readonly since_s: number;
}

/** Who has seen an alarm, and when. */
export interface Acknowledged {
  readonly by: string;
  readonly at_s: number;
}

/** An alarm with its entry in the catalogue. ``robots`` are the cars that it may be about; ``named`` says whether an alert has named them. ``acknowledged`` is null unless it is raised and somebody has seen it since. */
export interface AlarmEntry {
  readonly name: string;
  readonly about: string;
  readonly state: "OK" | "ALARM" | "INSUFFICIENT_DATA";
  readonly reason: string;
  readonly since_s: number;
  readonly key: string;
  readonly meaning: string;
  readonly advice: string;
  readonly evidence: "quarantine" | "logs" | "cars";
  readonly threshold: number | null;
  readonly robots: readonly string[];
  readonly named: boolean;
  readonly acknowledged: Acknowledged | null;
}

/** Answers ``alarms``, the raised ones first; ``user`` is who acknowledges if the viewer gives no name. */
export interface AlarmsAnswer {
  readonly alarms: readonly AlarmEntry[];
  readonly user: string;
}

/** A message in quarantine; ``robot`` is "-" if it is unknown. */
export interface Rejected {
  readonly id: string;
  readonly robot: string;
  readonly source: string;
  readonly topic: string;
  readonly reason: string;
  readonly last_s: number;
  readonly seen: number;
}

/** Answers ``rejected``: the newest messages in quarantine; ``found`` may exceed their number. */
export interface RejectedAnswer {
  readonly rejected: readonly Rejected[];
  readonly found: number;
}

/** A dashboard's widget; ``number`` is its place in the dashboard's body. */
export interface Widget {
  readonly x: number;
  readonly y: number;
  readonly width: number;
  readonly height: number;
  readonly title: string;
  readonly kind: "series" | "number" | "alarms" | "log" | "text" | "other";
  readonly text: string;
  readonly period_s: number;
  readonly series: readonly Series[];
  readonly alarms: readonly Alarm[];
  readonly number: number;
}

/** Answers ``dashboard``: a CloudWatch dashboard with its values. */
export interface Dashboard {
  readonly name: string;
  readonly from_s: number;
  readonly to_s: number;
  readonly widgets: readonly Widget[];
}

/** Answers ``log``: the result of a log widget; ``found`` may exceed the number of rows. The first line of a cell says what happened. */
export interface Logs {
  readonly columns: readonly string[];
  readonly rows: readonly (readonly string[])[];
  readonly found: number;
  readonly from_s: number;
  readonly to_s: number;
}
// [[[end]]]

/* A shim over an interpolator library, for the `orl` interpolator.
 *
 * The vendor's library with the calls of its published header needs none: the interpolator binds it as it is. Where yours
 * has other calls, build a few lines of C against its header that export these four, and give that library to the
 * interpolator (CALIBRATION_ORL_LIBRARY=/path/to/library.so). No name here is one of the vendor's.
 *
 * Millimetres and degrees throughout, as on the controller; frames and poses are x, y, z, a, e, r with Euler ZYZ.
 * Setting something returns 0 for success, anything else is an error.
 */
#ifndef CALIBRATION_ORL_SHIM_H
#define CALIBRATION_ORL_SHIM_H

#ifdef __cplusplus
extern "C" {
#endif

/* What a step answers; any other number is an error. NEED_DATA is MOVING, and one more move may be announced. */
enum { CALIBRATION_MOVING = 0, CALIBRATION_NEED_DATA = 1, CALIBRATION_FINAL = 2, CALIBRATION_IDLE = -42 };

/* Constants number from 0 in the order of the comment. */
typedef struct {
    int size;                    /* sizeof(calibration_move): a library built for another layout refuses */
    int joints;                  /* of the arm, at most 10 */
    int first;                   /* 1 where the arm rests at `start` before this move */
    int fly;                     /* 1 for MOVEFLY: the next move is announced before this one ends */
    int movement;                /* LINEAR, JOINT, CIRCULAR */
    int fly_type;                /* FLY_NORM, FLY_CART */
    int fly_trajectory;          /* FLY_AUTO, FLY_TOL, FLY_PASS, FLY_FROM */
    int speed_option;            /* SPD_LIN, SPD_CONST, SPD_JNT, SPD_ROT */
    int orientation;             /* RS_WORLD, RS_TRAJ, EUL_WORLD, WRIST_JNT */
    int termination;             /* FINE, COARSE, JNT_FINE, JNT_COARSE, NOSETTLE */
    int target_is_joints;        /* what `target` holds: joints, or a pose in the user frame */
    int via_is_joints;
    double fly_distance;         /* mm */
    double fly_percent;
    double stress_percent;
    double linear_speed;         /* m/s */
    double rotational_speed;     /* rad/s */
    double speed_override;       /* percent, as are the next three */
    double acceleration_override;
    double deceleration_override;
    double arm_override;
    double start[10];
    double target[10];
    double via[10];              /* CIRCULAR alone */
    double base[6];
    double tool[6];
    double uframe[6];
    char configuration[80];
} calibration_move;

int calibration_interpolator_period(double milliseconds);
/* At most two moves are announced and not ended: the active one and the next. */
int calibration_interpolator_move(const calibration_move *move);
/* Joints of the next set-point; FINAL with the last one before standstill, IDLE where nothing was announced. */
int calibration_interpolator_step(double joints[10]);
/* Forgets what was announced: the arm rests. */
int calibration_interpolator_cancel(void);

#ifdef __cplusplus
}
#endif
#endif

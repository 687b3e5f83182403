/* What the `orl` interpolator expects of a library.
 *
 * The vendor's ORL library is licensed and its own header is not public: where its functions take other arguments, build a
 * few lines of C against the vendor's header that export these three, and give that library to the interpolator
 * (CALIBRATION_ORL_LIBRARY=/path/to/library.so).
 *
 * Millimetres and degrees throughout, as on the controller; frames and poses are x, y, z, a, e, r with Euler ZYZ.
 * All functions return a status. Setting something: 0 is success, anything else an error.
 */
#ifndef CALIBRATION_ORL_SHIM_H
#define CALIBRATION_ORL_SHIM_H

#ifdef __cplusplus
extern "C" {
#endif

enum { ORL_MOVING = 0, ORL_FINAL = 2, ORL_IDLE = -42 };

/* Constants number from 0 in the order of the comment. */
typedef struct {
    int size;                    /* sizeof(orl_move): a library built for another layout refuses */
    int joints;                  /* of the arm, at most 10 */
    int first;                   /* 1 where the arm rests at `start` before this move */
    int movement;                /* LINEAR, JOINT, CIRCULAR */
    int fly;                     /* 1 for MOVEFLY: the next move is announced before this one is stepped through */
    int fly_type;                /* FLY_NORM, FLY_CART */
    int fly_trajectory;          /* FLY_AUTO, FLY_TOL, FLY_PASS, FLY_FROM */
    int speed_option;            /* SPD_LIN, SPD_CONST, SPD_JNT, SPD_ROT */
    int orientation;             /* RS_WORLD, RS_TRAJ, EUL_WORLD, WRIST_JNT */
    int termination;             /* FINE, COARSE, JNT_FINE, JNT_COARSE, NOSETTLE */
    int target_is_joints;        /* what `target` holds: joints, or a pose in the user frame */
    int reserved;
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
    double via[6];               /* CIRCULAR alone */
    double base[6];
    double tool[6];
    double uframe[6];
    char configuration[64];
} orl_move;

int ORL_set_interpolation_time(double milliseconds);
int ORL_set_move_parameters(const orl_move *move);
/* Joints of the next set-point; ORL_FINAL with the last one before standstill, ORL_IDLE where nothing was announced. */
int ORL_get_next_interpolation_step(double joints[10]);

#ifdef __cplusplus
}
#endif
#endif
